"""Defines what a task plugin is: a protocol in ten lines of data, from which cells and splits follow."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from dlobench.bench.calibration import SAMPLES
from dlobench.bench.regions import Region
from dlobench.data.domain_set import PARTS, Cell, DomainSet, Part, ScaleName, Span
from dlobench.data.imported_set import ImportedSet
from dlobench.data.sets import find
from dlobench.errors import UsageError

DISJOINT_SUPPORTS = 10  # supports that a small K is averaged over, where the pool holds as many


@dataclass(frozen=True)
class Scale:
    """Says how much of its set a task uses at one scale; K + query never exceed what a domain has."""

    trajectories: tuple[int, ...]  # a training domain, one fit each
    support: int  # trajectories of an unseen domain that supports are drawn from
    query: int  # trajectories of an unseen domain that are scored, the same for every K; re-executed ones count once
    K: tuple[int, ...]  # trajectories in a support


@dataclass(frozen=True)
class Noise:
    """Says how imperfect measurements are: standard deviations of what is added to every pose, each independently."""

    position: float  # m, of x and of y
    yaw: float  # rad


@dataclass(frozen=True)
class Fit:
    """Names one fit: how much it trains on and how far ahead it predicts. It serves every K."""

    trajectories: int
    horizon: int
    domain: int | None = None  # the only one it is about, where a task fits every domain apart
    without: str | None = None  # the region that it does not train on and is tested on

    @property
    def key(self) -> tuple[int, int, int | None, str | None]:
        """Returns what tells fits of a run apart."""
        return self.trajectories, self.horizon, self.domain, self.without


@dataclass(frozen=True)
class Task:
    """Describes a protocol. A published task is never edited: a new version is a new task."""

    name: str
    version: int
    set: str
    horizon: tuple[int, ...]  # n, pushes ahead
    mini: Scale
    small: Scale
    paper: Scale
    where: Mapping[str, object] = field(default_factory=dict)  # fields of the set's cells; a tuple: any of its values
    apart: bool = False  # whether every domain has a fit of its own, scored on other trajectories of that domain
    rolled: bool = False  # whether models, fitted for 1 push, are applied to their own predictions to the farthest n
    futures: str | None = None  # set of re-executed commands that samples are scored on; then models see commands alone
    noise: Noise | None = None  # of what is measured: of validation, support and query, never of the truth
    left_out: tuple[Region, ...] = ()  # each is a fit more, which trains outside of it and is tested inside
    imported: ImportedSet | None = None  # the set, where it is none of ours
    fresh: int | None = None  # seed of sets that are like the task's, but new

    @property
    def of(self) -> DomainSet:
        """Returns the set that the task reads."""
        return self._set(self.set) if self.imported is None else self.imported

    def _set(self, name: str) -> DomainSet:
        return find(name) if self.fresh is None else find(name).fresh(self.fresh)

    @property
    def samples(self) -> int:
        """Returns how many samples a model is asked for."""
        return 1 if self.futures is None else SAMPLES

    def set_of(self, part: Part) -> DomainSet:
        """Returns the set that a part is read from."""
        return self.of if self.futures is None or part != "test" else self._set(self.futures)

    def on(self, imported: ImportedSet) -> Task:
        """Returns the task on an imported set, whose every byte its name tells: a board never mixes it with another.

        Raises `UsageError` where the task needs what only a simulator can tell.
        """
        if self.futures is not None or any(region.outside for region in self.left_out):
            what = "commands that were executed again and again" if self.futures else "parameters of domains"
            raise UsageError(f"task {self.name!r} needs {what}, which imported sets do not have")
        of = imported.parted_like(self.of)
        return replace(self, name=f"{self.name}-on-{of.key}", set=of.name, imported=of)

    def check(self, scale: ScaleName) -> None:
        """Raises `UsageError`, naming field and value, for what no run could honour at a scale."""
        chosen, of = self.scale(scale), self.of
        executions = self.set_of("test").executions
        counts = {part: [span.count for span in self._spans(scale) if span.part == part] for part in PARTS}
        most = {part: min(found, default=0) for part, found in counts.items()}
        unseen = most["test"] // executions if self.apart else min(most["valid"], most["test"])

        def numbers(field: str, values: object, low: int, high: int) -> None:
            if not isinstance(values, tuple) or not values or len(set(values)) < len(values):
                raise UsageError(f"task {self.name!r}: {field} = {values!r} is not a tuple of different numbers")
            for value in values:
                if type(value) is not int or not low <= value <= high:
                    raise UsageError(
                        f"task {self.name!r}: {field} = {value!r} is not a whole number from {low} to {high}"
                    )

        if not isinstance(self.name, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", self.name):
            raise UsageError(f"task name {self.name!r} goes into paths; use letters, digits and any of _ . -")
        numbers("version", (self.version,), 1, 10**6)
        if not all(most.values()):
            part = next(part for part, count in most.items() if not count)
            raise UsageError(f"task {self.name!r}: no {part} domain of {self.set}/{scale} has {dict(self.where)}")
        if self.apart and of.parted != "trajectories":
            raise UsageError(
                f"task {self.name!r}: apart needs domains that have all parts, those of {self.set} have one"
            )
        if self.futures is not None and (not self.apart or len(self.set_of("test")) != len(of)):
            raise UsageError(f"task {self.name!r}: futures = {self.futures!r} are not those of domains fitted apart")
        if not all(re.fullmatch(r"[a-z]+", region.name) for region in self.left_out):
            raise UsageError(f"task {self.name!r}: left_out = {self.left_out} have names that are not of small letters")
        numbers("horizon", self.horizon, 1, self.set_of("test").pushes)
        largest = max(counts["train"]) if self.apart else most["train"]  # what some domains lack others may have
        numbers(f"{scale}.trajectories", chosen.trajectories, 1, largest)
        numbers(f"{scale}.support", (chosen.support,), 0, unseen)
        numbers(f"{scale}.query", (chosen.query,), 1, unseen)
        numbers(f"{scale}.support + query", (chosen.support + chosen.query,), 1, unseen)
        numbers(f"{scale}.K", chosen.K, 0, chosen.support)

    def scale(self, name: ScaleName) -> Scale:
        """Returns what the task uses at a scale."""
        return {"mini": self.mini, "small": self.small, "paper": self.paper}[name]

    def spans(self, scale: ScaleName) -> dict[Part, list[Span]]:
        """Returns what the task reads at a scale, part by part: domains and how many trajectories of each."""
        chosen, found = self.scale(scale), self._spans(scale)
        unseen = (chosen.support + chosen.query) * self.set_of("test").executions

        def count(span: Span) -> int:
            if span.part == "train":
                return max((size for size in chosen.trajectories if size <= span.count), default=0)
            return span.count if self.apart and span.part == "valid" else unseen

        return {part: [span.head(count(span)) for span in found if span.part == part] for part in PARTS}

    def _spans(self, scale: ScaleName) -> list[Span]:
        """Returns the sets' spans that the task is about, whole and in the order of their domains."""
        fields = Cell.__dataclass_fields__
        for name in self.where:
            if name not in fields:
                raise UsageError(f"task {self.name}: where has {name!r}, a cell has: {', '.join(fields)}")
        spans = [
            span
            for part in PARTS
            for of in [self.set_of(part)]
            for span in of.spans(scale)
            if span.part == part and of.cell(span.domain).within(self.where)
        ]
        return sorted(spans, key=lambda span: (span.domain, span.first))

    def fits(self, scale: ScaleName) -> list[Fit]:
        """Returns the fits of a scale, domain by domain where they are fitted apart, smallest first.

        Regions that hold no domain to test at that scale, or leave none to train on, have none.
        """
        sizes, spans = self.scale(scale).trajectories, self.spans(scale)
        domains = {span.domain: span.count for span in spans["train"]} if self.apart else {None: max(sizes)}
        found = [
            Fit(size, n, domain, without)
            for domain, most in domains.items()
            for without in [None, *(region.name for region in self.left_out)]
            for size in sizes
            if size <= most
            for n in ((1,) if self.rolled else self.horizon)
        ]
        return [fit for fit in found if fit.without is None or all(self.parts(spans, fit).values())]

    def parts(self, spans: Mapping[Part, Sequence[Span]], fit: Fit) -> dict[Part, list[Span]]:
        """Returns what a fit trains on, validates on and is tested on, out of what the task reads."""
        region = next((each for each in self.left_out if each.name == fit.without), None)

        def belongs(span: Span, part: Part) -> bool:
            if fit.domain not in (None, span.domain):
                return False
            return region is None or region.holds(self.of, span.domain) == (part == "test")

        heads = {"train": [span.head(min(span.count, fit.trajectories)) for span in spans["train"]]}
        return {part: [s for s in heads.get(part, spans[part]) if belongs(s, part)] for part in PARTS}

    def sets(self, spans: Mapping[Part, Sequence[Span]]) -> list[tuple[DomainSet, list[Span]]]:
        """Returns the sets that are read, and all that is read of each."""
        found: dict[str, tuple[DomainSet, list[Span]]] = {}
        for part, members in spans.items():
            of = self.set_of(part)
            found.setdefault(of.key, (of, []))[1].extend(members)
        return [(of, members) for of, members in found.values() if members]

    def data_digest(self, spans: Mapping[Part, Sequence[Span]]) -> str:
        """Returns the definition digest (SHA-256) of all that is read, of one set or of several."""
        digests = [of.digest(members) for of, members in self.sets(spans)]
        return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()

    def ahead(self, fit: Fit) -> tuple[int, ...]:
        """Returns the numbers of pushes ahead that a fit is scored at."""
        return self.horizon if self.rolled else (fit.horizon,)

    def cell_id(self, fit: Fit, K: int, horizon: int | None = None) -> str:
        """Names one point of the sweep, such as `meta/trajectories20-h4-k10`; without K where domains are apart."""
        n = fit.horizon if horizon is None else horizon
        support = "" if self.apart else f"-k{K}"
        without = "" if fit.without is None else f"-without-{fit.without}"
        return f"{self.name}/trajectories{fit.trajectories}-h{n}{support}{without}"

    def cells(self, scale: ScaleName, Ks: Sequence[int]) -> list[str]:
        """Returns the names of all points of the sweep at some K."""
        return list(dict.fromkeys(self.cell_id(f, K, n) for f in self.fits(scale) for n in self.ahead(f) for K in Ks))


def split_digest(spans: Mapping[Part, Sequence[Span]]) -> str:
    """Returns the SHA-256 of which trajectories of which domains play which part."""
    parts = {part: [(s.domain, s.first, s.count) for s in members] for part, members in spans.items()}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def supports(pool: int, K: int) -> list[slice]:
    """Returns disjoint supports of K trajectories out of a pool: at most ten; for K = 0 one empty one.

    Examples:
        >>> supports(pool=10, K=4)
        [slice(0, 4, None), slice(4, 8, None)]
        >>> len(supports(pool=50, K=1)), supports(pool=10, K=0)
        (10, [slice(0, 0, None)])

    """
    if K == 0:
        return [slice(0, 0)]
    return [slice(i * K, (i + 1) * K) for i in range(min(DISJOINT_SUPPORTS, pool // K))]
