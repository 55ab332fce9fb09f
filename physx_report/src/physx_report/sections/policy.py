"""The section on how good a network is that acts in an environment."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from itertools import cycle

from matplotlib.ticker import MaxNLocator

from physx_core.results import PolicyResult
from physx_report import drawing, wording
from physx_report.blocks import Block, Picture, Table, Text
from physx_report.run import Run
from physx_report.section import Section

_MOST_BYTES = 3_000_000
_UNITS = {"length": " / steps", "speed": " / (m/s)"}


def _blocks(run: Run) -> Iterator[Block]:
    result = run.results.get("evaluation")
    if result is None or not result.policies:
        return
    for name, each in result.policies.items():
        first, *others = each.lines(name)
        yield Text([first], "verdict")
        yield Text([line.strip() for line in others])
    yield _table(result.policies)
    for name, policy in result.policies.items():
        yield from _rewards(name, policy)
        yield from _film(run, name, policy)


def _table(policies: Mapping[str, PolicyResult]) -> Table:
    names = list(dict.fromkeys(n for each in policies.values() for n in each.figures))
    rows = []
    for name, each in policies.items():
        values = each.values
        limits = "" if each.interval is None else " to ".join(map(wording.number, each.interval))
        others = [wording.number(values[n]) if n in values else "" for n in names]
        rows.append([name, wording.number(values["reward"]), limits, str(len(each.seeds)), *others])
        for rival, of in each.rivals.items():
            blank = [""] * len(names)
            rows.append([rival, wording.number(of.mean), "", str(len(of.rewards)), *blank])
    head = ["", "reward", "95 % interval", "episodes", *(f"{n}{_UNITS.get(n, '')}" for n in names)]
    marks = [place for place, row in enumerate(rows) if row[0] in policies]
    return Table(head, rows, "Means over episodes", marks)


def _rewards(name: str, policy: PolicyResult) -> Iterator[Block]:
    caption = f"{name}. Reward of each episode, by its seed, of the checkpoint {policy.network}"
    with drawing.figure(caption, height=2.8) as (found, (axes,)):
        colors = drawing.TRUTH, drawing.MUTED
        for (label, of), color in zip(policy.rivals.items(), cycle(colors), strict=False):
            axes.plot(policy.seeds, of.rewards, ".", color=color, label=label)
        axes.plot(policy.seeds, policy.rewards, "o", ms=4, color=drawing.PREDICTION, label="policy")
        axes.set_xlabel("seed of the episode")
        axes.set_ylabel("reward")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.ticklabel_format(useOffset=False, axis="x")
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    yield from found


def _film(run: Run, name: str, policy: PolicyResult) -> Iterator[Block]:
    """Show the film of an evaluation, or say how to make one."""
    session = shlex.quote(str(run.path))
    engine = f" --backend {policy.backend}" if policy.backend else ""
    again = f"physx evaluate {session} --env {policy.environment}{engine}"
    file = run.path / policy.film
    if not policy.film:
        yield Text(["There is no film of it. With an environment of a robot, this makes one:"])
        name = f"film_{policy.backend}" if policy.backend else "film"
        yield Text([f"{again} --film {session}/{name}.webp"], "code")
        return
    content = file.read_bytes() if file.is_file() and file.stat().st_size < _MOST_BYTES else b""
    picture = Picture(content, f"{name}. The episode with the seed {policy.seeds[0]}")
    yield picture if picture.mime else Text([f"Its film: {file}."])


SECTION = Section("How good the policy is", _blocks, 12)
