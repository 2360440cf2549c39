"""Specifies the page's charts in Vega-Lite; the page's script gives them their points."""

from __future__ import annotations

from typing import Any

OKABE_ITO = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F", "#A6761D"]
SHAPES = ["circle", "square", "triangle-up", "diamond", "cross", "triangle-down", "triangle-right", "triangle-left"]
DASHES = [[1, 0], [6, 3], [2, 2], [8, 3, 2, 3], [4, 2], [1, 3], [10, 4], [6, 2, 1, 2]]
MODELS = 8  # that a chart shows

MODEL = {
    "color": {"field": "model", "type": "nominal", "title": None, "scale": {"range": OKABE_ITO}},
    "shape": {"field": "model", "type": "nominal", "title": None, "scale": {"range": SHAPES}},
}
DASH = {"strokeDash": {"field": "model", "type": "nominal", "title": None, "legend": None, "scale": {"range": DASHES}}}
ERROR = {
    "field": "y",
    "type": "quantitative",
    "title": "Mean squared error (cm²)",
    "scale": {"type": "log"},
    "axis": {"tickCount": 5},
}


def _told(*more: tuple[str, str]) -> list[dict[str, str]]:
    fields = (("model", "Model"), ("cell", "Cell"), *more)
    return [{"field": field, "title": title, "type": "nominal"} for field, title in fields]


def _chart(name: str, title: str, note: str, **spec: Any) -> dict[str, Any]:
    whole = {"$schema": "https://vega.github.io/schema/vega-lite/v6.json", "width": "container", "height": 240}
    return {"id": name, "title": title, "note": note, "spec": whole | spec}


def _sweep(name: str, title: str, axis: str) -> dict[str, Any]:
    encoding = {
        "x": {"field": "x", "type": "ordinal", "title": axis, "axis": {"labelAngle": 0}},
        "y": ERROR,
        "tooltip": _told(("x", axis), ("shown", "Mean squared error (cm²)")),
    }
    note = "Over the domains that have every value on the axis, of models that have them all."
    layer = [  # lines are coloured by stroke: by color, they would add a legend of their own
        {"mark": {"type": "line"}, "encoding": {"stroke": MODEL["color"] | {"legend": None}} | DASH},
        {"mark": {"type": "point", "filled": True, "opacity": 1, "size": 60}, "encoding": MODEL},
    ]
    return _chart(name, title, note, encoding=encoding, layer=layer)


def _pareto(name: str, title: str, axis: str, least: float) -> dict[str, Any]:
    x = {"field": "x", "type": "quantitative", "title": axis, "scale": {"type": "log"}, "axis": {"tickCount": 4}}
    tooltip = _told(("x", axis), ("shown", "Mean squared error (cm²)"))
    layer = [
        {
            "transform": [{"filter": "datum.front"}],
            "mark": {"type": "line", "interpolate": "step-after", "color": "#7F7F7F", "strokeWidth": 1.5},
        },
        {"mark": {"type": "point", "filled": True, "opacity": 1, "size": 80}, "encoding": MODEL | {"tooltip": tooltip}},
    ]
    note = f"The line joins those that no other beats on both. Times below {least:g} are drawn there."
    return _chart(name, title, note, encoding={"x": x, "y": ERROR}, layer=layer) | {"least": least}


CHARTS = [
    _sweep("horizon", "Error against horizon", "Horizon (pushes ahead)"),
    _sweep("trajectories", "Error against training size", "Training trajectories per domain"),
    _sweep("K", "Error against adaptation", "K (trajectories to adapt on)"),
    _pareto("fit", "Error against training time", "Training time (s)", 0.01),
    _pareto("predict", "Error against prediction time", "Prediction time per query (ms)", 0.001),
    _chart(
        "coverage", "Calibration: coverage", "A calibrated model has half of the truths in its 50 % interval.",
        layer=[
            {
                "mark": {"type": "rule", "strokeDash": [4, 3], "color": "#7F7F7F"},
                "data": {"values": [{"a": 0, "b": 1}]},
                "encoding": {"x": {"field": "a", "type": "quantitative"}, "y": {"field": "a", "type": "quantitative"},
                             "x2": {"field": "b"}, "y2": {"field": "b"}},
            },
            {
                "mark": {"type": "point", "filled": True, "opacity": 1, "size": 80},
                "encoding": MODEL | {
                    "x": {"field": "x", "type": "quantitative", "title": "Level of the interval",
                          "scale": {"domain": [0, 1]}, "axis": {"format": "%", "values": [0, 0.5, 0.9]}},
                    "y": {"field": "y", "type": "quantitative", "title": "Truths inside",
                          "scale": {"domain": [0, 1]}, "axis": {"format": "%"}},
                    "tooltip": _told(("x", "Level"), ("shown", "Truths inside")),
                },
            },
        ],
    ),
    _chart(
        "ranks", "Calibration: rank histogram", "A calibrated model is flat at 1; ∪ is too narrow, ∩ too wide.",
        mark={"type": "line", "interpolate": "step"},
        encoding={
            "x": {"field": "x", "type": "quantitative", "title": "Rank of the truth among samples",
                  "axis": {"format": "%"}},
            "y": {"field": "y", "type": "quantitative", "title": "Frequency, 1 = flat", "scale": {"zero": True}},
            "color": MODEL["color"],
            "tooltip": _told(("shown", "Frequency")),
        } | DASH,
    ),
]  # fmt: skip

CURVE = _chart(
    "curve", "Learning curve", "", height=180,
    mark={"type": "line", "point": True},
    encoding={
        "x": {"field": "x", "type": "quantitative", "title": "Step"},
        "y": {"field": "y", "type": "quantitative", "title": "Logged value"},
        "detail": {"field": "fit", "type": "nominal"},
        "color": {"field": "what", "type": "nominal", "title": None, "scale": {"range": OKABE_ITO}},
        "strokeDash": {"field": "what", "type": "nominal", "title": None, "scale": {"range": DASHES}},
    },
)  # fmt: skip
