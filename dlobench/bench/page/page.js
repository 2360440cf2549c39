// Joins data, table and charts. Text from records is set as text, or escaped by `text`; it never becomes HTML.
const { rows, runs, charts, curve } = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const text = (value) => String(value).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
const dark = matchMedia("(prefers-color-scheme: dark)").matches;
const none = "–";
const digits = (value, n) => (value === null || value === undefined ? none : value.toFixed(n));
const brief = (value) => (value === null || value === undefined ? none : String(Number(value.toPrecision(3))));
const scaled = (value, by) => (value === null || value === undefined ? null : value * by);
const named = (row) => `${row.model}@${row.config}`;
const make = (tag, content, parent) => {
  const element = document.createElement(tag);
  if (content !== undefined) element.textContent = content;
  if (parent) parent.append(element);
  return element;
};

const largest = (all, key) => {
  const rivals = {};
  all.forEach((row) => (rivals[key(row)] ??= new Set()).add(named(row)));
  return all.reduce((best, row) => (rivals[key(row)].size > rivals[key(best)].size ? row : best));
};
const chosen = () => ["task", "scale", "cell", "material", "search"].reduce((o, id) => ({ ...o, [id]: at(id).value }), {});
// What a row says of the chosen material: no interval and no place, which are those of all domains.
function seen(row, material) {
  if (!material) return row;
  const found = row.materials[material];
  if (!found) return null;
  const [skill, mse_m2, euclidean_m, domains] = found;
  return { ...row, skill, mse_m2, euclidean_m, domains, place: null, tie: "", skill_low: null, skill_high: null,
    mse_low: null, mse_high: null, energy_m: null, coverage90: null, skill_equal_time: null, rank: null, rank_low: null, rank_high: null };
}
function visible() {
  const { task, scale, cell, material, search } = chosen();
  const words = search.toLowerCase().split(/\s+/).filter(Boolean);
  return rows
    .filter((row) => (!task || row.task === task) && (!scale || row.scale === scale) && (!cell || row.cell === cell))
    .filter((row) => words.every((word) => `${row.task} ${row.scale} ${row.cell} ${named(row)} ${row.settings} ${row.without}`.toLowerCase().includes(word)))
    .map((row) => seen(row, material)).filter(Boolean);
}

function bar(value, low, high, from, to) {
  if (value === null) return "";
  const x = (v) => (100 * (Math.min(Math.max(v, from), to) - from)) / (to - from || 1);
  const line = low === null ? "" : `<line x1="${x(low)}%" x2="${x(high)}%" y1="5" y2="5"/>`;
  const zero = from < 0 && to > 0 ? `<line class="zero" x1="${x(0)}%" x2="${x(0)}%" y1="0" y2="10"/>` : "";
  return `<svg class="bar" aria-hidden="true">${zero}${line}<circle cx="${x(value)}%" cy="5" r="3.5"/></svg>`;
}
const skills = [Math.max(-1, Math.min(0, ...rows.slice(0, 5000).map((r) => r.skill_low ?? r.skill))), 1];
const interval = (low, high, n) => (low === null ? "" : ` <span class="scale">${digits(low, n)} to ${digits(high, n)}</span>`);
// Column: header, value to sort by, what is shown (escaped HTML), class
const number = "number", wide = "number wide";
const plain = (title, get, shown, cls = wide) => ({ title, className: cls, type: "num", data: null,
  render: (_, kind, row) => { const v = get(row); return kind === "display" ? text(shown(v)) : v ?? (kind === "sort" ? -1e300 : ""); } });
const word = (title, get, cls = "wide") => ({ title, className: cls, data: null, type: "string", render: (_, kind, row) => (kind === "display" ? text(get(row)) : get(row)) });
const columns = [
  { title: "Place", className: number, type: "num", data: null,
    render: (_, kind, row) => (kind === "display" ? (row.place === null ? none : `${row.place}${row.tie ? `<span title="ties with a neighbour"> ≈</span>` : ""}`) : row.place ?? 1e9) },
  { title: "Model", className: "model", cellType: "th", type: "string", data: null,
    render: (_, kind, row) => (kind === "display" ? `<button type="button" data-row="${row.id}" aria-haspopup="dialog">${text(row.model)}</button> <span class="config">${text(row.config)}</span>${row.settings && `<span class="config settings">${text(row.settings)}</span>`}` : named(row)) },
  { title: "Skill", className: number, type: "num", data: null,
    render: (_, kind, row) => (kind === "display" ? `${digits(row.skill, 3)}${interval(row.skill_low, row.skill_high, 3)}${bar(row.skill, row.skill_low, row.skill_high, ...skills)}` : row.skill ?? -1e300) },
  word("Task", (row) => row.task), word("Scale", (row) => row.scale), word("Cell", (row) => row.cell.replace(/^[^/]*\//, ""), ""),
  { title: "MSE (cm²)", className: wide, type: "num", data: null,
    render: (_, kind, row) => (kind === "display" ? `${brief(scaled(row.mse_m2, 1e4))}${row.mse_low === null ? "" : ` <span class="scale">${brief(row.mse_low * 1e4)} to ${brief(row.mse_high * 1e4)}</span>`}` : row.mse_m2) },
  plain("Error (mm)", (row) => scaled(row.euclidean_m, 1e3), (v) => digits(v, 2), number),
  plain("Energy score (mm)", (row) => scaled(row.energy_m, 1e3), (v) => digits(v, 2)),
  plain("Coverage at 90 %", (row) => scaled(row.coverage90, 100), (v) => digits(v, 0)),
  plain("Skill at equal time", (row) => row.skill_equal_time, (v) => digits(v, 3)),
  plain("Rank over cells", (row) => row.rank, brief),
  plain("Training (s)", (row) => row.fit_s, brief), plain("Prediction (ms)", (row) => scaled(row.predict_s, 1e3), brief),
  plain("Parameters", (row) => row.parameters, (v) => v.toLocaleString("en")), plain("Seeds", (row) => row.seeds, brief),
];
const some = { 8: "energy_m", 9: "coverage90", 10: "skill_equal_time" };
let table;

function fill(id, values, all) {
  const before = at(id).value;
  at(id).replaceChildren();
  if (all !== undefined) make("option", all, at(id)).value = "";
  values.forEach((value) => { make("option", value, at(id)).value = value; });
  at(id).value = values.includes(before) ? before : all === undefined ? values[0] : "";
}
const distinct = (name, from = rows) => [...new Set(from.map((row) => row[name]))];
function show() {
  const { task, scale, material } = chosen();
  fill("cell", distinct("cell", rows.filter((row) => (!task || row.task === task) && (!scale || row.scale === scale))), "All cells");
  const found = visible();
  table.clear().rows.add(found);
  table.column(3).visible(!task, false); table.column(4).visible(!scale, false); table.column(0).visible(!material, false);
  Object.entries(some).forEach(([i, name]) => table.column(i).visible(found.some((row) => row[name] !== null), false));
  table.draw();
  at("note").textContent = `${found.length} of ${rows.length} rows.` + (material ? ` Skill and errors are of ${material} domains alone, by MSE; intervals and places are of all materials and not shown.` : "");
  draw(found);
}

async function picture(parent, chart, values) {
  const ink = dark ? "#ececec" : "#1b1b1b", line = dark ? "#444" : "#ddd";
  const axis = { labelColor: ink, titleColor: ink, gridColor: line, domainColor: line, tickColor: line, titleFontWeight: "normal" };
  const config = { background: "transparent", font: "system-ui, sans-serif", axis, legend: { labelColor: ink, orient: "bottom", columns: 2, labelLimit: 220, symbolLimit: 8 }, view: { stroke: null } };
  const spec = { ...chart.spec, data: { values }, description: `${chart.title}. ${values.length} points; the table has the numbers.`, autosize: { type: "fit-x", contains: "padding" } };
  await window.vegaEmbed(parent, spec, { actions: false, renderer: "svg", ast: true, config });
}
function points(id, chart, found, material) {
  const base = (row) => ({ model: named(row), cell: row.cell });
  const out = [];
  found.forEach((row) => {
    const add = (x, y, more) => y > 0 && out.push({ ...base(row), x, y, shown: brief(y), ...more });
    if (["horizon", "trajectories", "K"].includes(id)) {
      add(row[id], scaled(row.sweeps[id]?.[material], 1e4));
    } else if (id === "fit" || id === "predict") {
      const time = id === "fit" ? row.fit_s : scaled(row.predict_s, 1e3);
      if (time !== null) add(Math.max(time, chart.least), row.mse_m2 * 1e4);
    } else if (id === "coverage" && row.coverage) [0.5, 0.9].forEach((x, i) => out.push({ ...base(row), x, y: row.coverage[i], shown: digits(row.coverage[i], 3) }));
    else if (id === "ranks" && row.ranks) {
      const total = row.ranks.reduce((a, b) => a + b, 0);
      row.ranks.forEach((n, i) => total && add((i + 0.5) / row.ranks.length, (n * row.ranks.length) / total));
    }
  });
  if (chart.least) out.forEach((p) => { p.front = !out.some((q) => q.cell === p.cell && q.x <= p.x && q.y <= p.y && (q.x < p.x || q.y < p.y)); });
  return out;
}
let drawing = 0;
const words = { horizon: "horizon", trajectories: "training trajectories", K: "K" };
async function draw(found) {
  const turn = ++drawing, { material } = chosen();
  at("charts").replaceChildren();
  if (new Set(found.map((row) => `${row.task} ${row.scale}`)).size !== 1) {
    at("charted").textContent = found.length ? "Choose one task and one scale to see their charts." : "No row is left by the filters.";
    return;
  }
  const best = new Map(); // mean skill of each model over its rows
  found.forEach((row) => best.set(named(row), [...(best.get(named(row)) ?? []), row.skill ?? -9]));
  const order = [...best].map(([name, s]) => [s.reduce((a, b) => a + b, 0) / s.length, name]).sort((a, b) => b[0] - a[0] || (a[1] < b[1] ? -1 : 1));
  const models = order.slice(0, 8).map(([, name]) => name);
  at("charted").textContent = `${found[0].task}, ${found[0].scale}` + (order.length > 8 ? `: the 8 of ${order.length} models with the best mean skill.` : ".");
  // One setting of what a chart does not sweep: that of the chosen cell, or the largest.
  const { cell } = chosen(), sweeps = ["horizon", "trajectories", "K"];
  const of = found.filter((row) => models.includes(named(row)));
  const last = of.find((row) => row.cell === cell) ?? [...of].sort((a, b) => (a.without < b.without ? -1 : a.without > b.without ? 1 : sweeps.reduce((d, name) => d || b[name] - a[name], 0)))[0];
  const every = rows.filter((row) => row.task === last.task && row.scale === last.scale && models.includes(named(row)));
  for (const chart of charts) {
    const swept = sweeps.includes(chart.id), fixed = sweeps.filter((name) => name !== chart.id);
    const among = swept ? every.filter((row) => fixed.every((name) => row[name] === last[name]) && row.without === last.without) : of.filter((row) => row.cell === last.cell);
    const values = points(chart.id, chart, among, material);
    if (turn !== drawing) return;
    const needs = swept ? 2 : 1;
    if (new Set(values.map((p) => p.x)).size < needs) continue;
    if (material && (chart.id === "coverage" || chart.id === "ranks")) continue; // they are of all materials
    const figure = make("figure", undefined, at("charts"));
    figure.className = "chart"; figure.id = `chart-${chart.id}`;
    make("h3", chart.title, figure); make("p", `${swept ? "At " + fixed.map((name) => `${words[name]} ${last[name]}`).join(", ") : "In " + last.cell.replace(/^[^/]*\//, "")}. ${chart.note}`, figure);
    await picture(make("div", undefined, figure), chart, values);
  }
}

function listed(parent, caption, head, lines) {
  if (!lines.length) return;
  const t = make("table", undefined, parent);
  t.before(make("h3", caption)); t.setAttribute("aria-label", caption);
  if (head) head.forEach((h, i, all) => { if (!i) all.row = make("tr", undefined, make("thead", undefined, t)); make("th", h, all.row).scope = "col"; });
  const body = make("tbody", undefined, t);
  lines.forEach(([first, ...others]) => { const tr = make("tr", undefined, body); make("th", first, tr).scope = "row"; others.forEach((o) => make("td", o, tr)); });
}
async function open(row) {
  const run = runs[row.run], told = at("told");
  told.replaceChildren();
  at("named").textContent = `${named(row)}: ${row.cell}, ${row.scale}`;
  make("h3", "Command to run it again", told);
  run.commands.forEach(([seed, command]) => { const pre = make("pre", undefined, told); pre.tabIndex = 0; pre.setAttribute("aria-label", `Command of seed ${seed}`); make("code", command, pre); });
  if (run.records > run.commands.length) make("p", `${run.commands.length} of ${run.records} seeds are shown.`, told);
  listed(told, "Scores by material", ["Material", "Skill by MSE", "MSE (cm²)", "Error (mm)", "Domains"],
    Object.entries(row.materials).map(([m, [s, e, d, n]]) => [m, digits(s, 3), brief(scaled(e, 1e4)), digits(scaled(d, 1e3), 2), n]));
  const values = run.curves.flatMap(([fit, by]) => Object.entries(by).flatMap(([what, ps]) => ps.filter((p) => p[0] !== null && p[1] !== null).map(([x, y]) => ({ fit, what, x, y }))));
  const place = values.length ? make("div", undefined, told) : null;
  if (run.failed) listed(told, `Fits that failed: ${run.failed}`, ["Seed", "Fit", "Error"], run.failures);
  listed(told, "Hyperparameters", null, run.hyperparameters);
  listed(told, "Provenance", null, run.about);
  at("record").showModal();
  at("record").scrollTop = 0;
  if (place) { make("h3", "Learning curve", place); await picture(make("div", undefined, place), curve, values); }
}

if (rows.length) {
  rows.forEach((row, i) => { row.id = i; });
  fill("task", distinct("task").sort(), "All tasks"); fill("scale", distinct("scale"), "All scales");
  fill("material", [...new Set(rows.flatMap((row) => Object.keys(row.materials)))].sort(), "All materials");
  const most = largest(rows, (row) => `${row.task} ${row.scale}`); // where most models meet
  at("task").value = most.task; at("scale").value = most.scale;
  table = new window.DataTable(at("table"), { columns, data: [], deferRender: true, autoWidth: false, order: [], pageLength: 50,
    layout: { topStart: null, topEnd: null, bottomStart: "info", bottomEnd: "paging" } });
  ["task", "scale", "cell", "material"].forEach((id) => at(id).addEventListener("change", show));
  at("search").addEventListener("input", show);
  at("filters").addEventListener("submit", (event) => event.preventDefault());
  at("table").addEventListener("click", (event) => { const b = event.target.closest("button[data-row]"); if (b) open(rows[Number(b.dataset.row)]); });
  at("close").addEventListener("click", () => at("record").close());
  show();
}
document.body.dataset.ready = "yes";
