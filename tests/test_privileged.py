"""Tests privileged models: they alone see the parameters of domains, and they have no place on the board."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_cli import Call, call, mini  # noqa: F401  # fixtures

from dlobench.bench import leaderboard, results

SOURCE = '''
"""Looks at what it is shown."""
from dataclasses import dataclass
import numpy as np
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

@dataclass
class Looking(Model):
    privileged = {privileged}

    def look(self, what):
        shown = what.parameters is not None and what.parameters.shape == (11,) and abs(what.parameters).max() <= 1
        assert bool(shown) is {privileged}, what.parameters

    def fit(self, train, valid, setting):
        [self.look(domain) for domain in (*train, *valid)]
        seen = {{domain.parameters.tobytes() if {privileged} else i for i, domain in enumerate(train)}}
        assert len(seen) == len(train), "every domain has its own"

    def adapt(self, support):
        self.look(support)
        return self

    def predict(self, query, samples):
        self.look(query)
        return Prediction(dlo=np.array(query.dlo[None, ..., :2]))
'''


@pytest.mark.parametrize("privileged", [True, False])
def test_who_is_privileged_alone_sees_parameters(privileged: bool, mini: Path, call: Call, tmp_path: Path) -> None:  # noqa: F811
    path, out = tmp_path / "looking.py", tmp_path / "runs"
    path.write_text(SOURCE.format(privileged=privileged))
    for model in ("persistence", path):
        done = call("run", "--task", "meta", "--K", 1, "--model", model, "--data", mini, "--out", out)
        assert done.code == 0, done.err
    (record,) = (one for one in results.read_all(out) if one.model == "looking")
    assert record.privileged is privileged
    row = leaderboard.table(results.read_all(out)).set_index("model").loc["looking"]
    assert bool(np.isnan(row["place"])) is privileged
    assert bool(np.isnan(row["rank"])) is privileged
    assert row["tie"] == ("" if privileged else "below")
    assert row["skill"] == 0
    assert ("–" in done.out) is privileged
