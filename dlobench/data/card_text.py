"""Words the card of a data set, in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dlobench.data.domain_set import PARTS, SCALES, DomainSet, ScaleName
from dlobench.data.store import COLUMNS as SHARD
from dlobench.data.store import WIDTH, data_bytes

LICENSE = "https://www.apache.org/licenses/LICENSE-2.0"
CITATION = (
    "DLO@Scale: A Large-Scale Meta Dataset for Learning Non-Rigid Object Pushing Dynamics. "
    "NeurIPS 2021 Workshop on Physical Reasoning and Inductive Biases for the Real World."
)
SUMMARY = (
    "Simulated pushes of deformable linear objects (ropes, rods, wires) and rigid bodies on a table, with many "
    "physical parameters: an independent rebuild of DLO@Scale, to learn dynamics from. Every byte can be made again."
)
_ABOUT = {
    "single-domain-large": "18 domains in the middle of the parameters' ranges, many pushes each: how does the error "
    "fall with the amount of data?",
    "single-domain-medium": "27 domains in the middle of the parameters' ranges that also vary in the length of the "
    "DLO, with fewer pushes each.",
    "meta-learning": "6300 domains with sampled parameters, of which a quarter is unseen in training: how fast does a "
    "model adapt?",
    "distribution": "The same commands executed again and again from the same states with fresh noise: samples of the "
    "true distribution over futures, to test generative models on.",
}
_FIELDS = {  # of a shard's row: shape, units
    "pusher": "x m, y m",
    "dlo": "up to 32 segment centres: x m, y m, yaw rad; padding is 0",
    "bodies": "up to 3 rigid bodies: x m, y m, yaw rad; padding is 0",
    "cylinder": "what an attached DLO ends in: x m, y m, yaw rad; not for models to see",
    "commanded": "the next displacement of the pusher as asked for: x m, y m; 0 after the last push",
    "executed": "the same plus execution noise: x m, y m; 0 after the last push",
}
_TEMPLATE = """\
---
license: apache-2.0
pretty_name: dlobench {name} ({scale})
tags: [robotics, dynamics, simulation]
---

# {name}, scale {scale}

{summary}

{about}

## Sizes

{sizes}
This card is of scale **{scale}**: {done:,} of its {wanted:,} shards are on disk, which `shards.parquet` lists.

## Shards

A shard is a float32 array {shape} of trajectories, states and columns in NumPy's format, beside a JSON sidecar with its
SHA-256, its seed, its domain and where it comes from. World frame, origin at the centre of the table, SI units.

{columns}
{tables}
## Made, and made again

MuJoCo simulates {pushes} pushes from each reset, biased towards the nearest segment, and executes them with noise. From
nothing but the definition of the set, the same bytes come out on the same kind of CPU:

```sh
dlobench generate {name} --scale {scale}
dlobench data verify {name}    # every byte against its SHA-256
```

{origin}
- Key, the folder of the set: `{key}`
- Definition, SHA-256 over domains, trajectories and parts: `{digest}`
- `shards.parquet`, SHA-256: `{sha256}`

## Known limits

- This is not the original data, which can no longer be had, nor its engine. Materials, friction and the policy that
  pushes follow the paper where it says what they are, and documented choices where it does not (`docs/adr/`).
- The world is planar: nothing rolls, twists, tips or lifts.
- A push may end in motion, which is not recorded: the next one begins at rest.
- Bits may differ from one kind of CPU to another. What defines the set (domains, seeds, parts) does not.
- Trajectories whose simulation failed were drawn again; each shard's sidecar counts them under `account`.

## License and citation

[Apache License 2.0]({license}), like the code that makes it. The paper whose data set this rebuilds:

> {citation}
"""


def text(
    of: DomainSet,
    scale: ScaleName,
    *,
    there: tuple[int, int],
    versions: Sequence[str],
    cpus: Sequence[str],
    sha256: str,
    tables: Mapping[str, Mapping[str, str]],
) -> str:
    """Returns the card: `there` counts shards on disk and in all, `sha256` is that of the table that lists them."""
    named = [f"## `{name}`\n\n{_table(('column', 'holds'), _named(columns))}" for name, columns in tables.items()]
    return _TEMPLATE.format(
        name=of.name,
        scale=scale,
        summary=SUMMARY,
        about=_ABOUT.get(of.name, ""),
        sizes=_sizes(of),
        done=there[0],
        wanted=there[1],
        shape=(of.block, of.pushes + 1, WIDTH),
        columns=_table(("columns", "field", "holds"), _columns()),
        tables="\n".join(named),
        pushes=of.pushes,
        origin="\n".join([f"- Software: {each}" for each in versions] + [f"- CPU: {each}" for each in cpus]),
        key=of.key,
        digest=of.digest(of.spans(scale)),
        sha256=sha256,
        license=LICENSE,
        citation=CITATION,
    )


def _sizes(of: DomainSet) -> str:
    rows = []
    for scale in SCALES:
        for part in PARTS:
            spans = [span for span in of.spans(scale) if span.part == part]
            if spans:
                trajectories = sum(span.count for span in spans)
                numbers = (len(spans), trajectories, of.total(spans), data_bytes(of, spans))
                rows.append((scale, part, *(f"{number:,}" for number in numbers)))
    return _table(("scale", "part", "domains", "trajectories", "pushes", "bytes"), rows)


def _columns() -> list[tuple[str, ...]]:
    rows, begin = list[tuple[str, ...]](), 0
    for name, width in SHARD.items():
        rows.append((f"{begin}–{begin + width - 1}", f"`{name}`", _FIELDS[name]))
        begin += width
    return rows


def _named(columns: Mapping[str, str]) -> list[tuple[str, str]]:
    return [(f"`{name}`", about) for name, about in columns.items()]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
