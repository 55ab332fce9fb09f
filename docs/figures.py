"""Runs benchmarks, keeps what they print in docs/figures/, and shows it in docs/figures.md.

python docs/figures.py NAME ...    # runs benchmarks/NAME.py: minutes, on a quiet machine
python docs/figures.py             # writes the page, and tables on others, from what is kept
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import kept

HERE = Path(__file__).resolve().parent
BENCHMARKS = HERE.parent / "benchmarks"
# Benchmarks that others start, that compare two versions, or that write their own page:
OTHERS = {"compare", "jiminy_zoo", "many_clients", "remote_servers", "robots", "transport_costs"}
FENCE = "<!-- not run: benchmarks take minutes -->\n```sh"


LEARNED = [f"learning_{env}" for env in ("Cartpole", "Acrobot", "Ant", "Quadruped", "PushBox")]
"""Parts of `learning`, which takes more than an hour: each environment is run, and kept, alone."""


def names() -> list[str]:
    """Return the names of all benchmarks, and of the parts of `learning` in its place."""
    found = {
        path.stem
        for path in BENCHMARKS.glob("*.py")
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    }
    listed = sorted(found - OTHERS)
    place = listed.index("learning")
    return [*listed[:place], *LEARNED, *listed[place + 1 :]]


def run(name: str) -> int:
    """Run a benchmark, or a part of one, and return its exit status."""
    benchmark, _, env = name.partition("_") if name in LEARNED else (name, "", "")
    words = ["--env", f"physx/{env}-v0"] if env else []
    return PAGE.keep(name, [sys.executable, str(BENCHMARKS / f"{benchmark}.py"), *words])


def section(name: str) -> str:
    """Return a benchmark's section of the page; of its further parts, only what they printed."""
    if name in LEARNED[1:]:
        return PAGE.printed(name)
    benchmark = "learning" if name in LEARNED else name
    source = (BENCHMARKS / f"{benchmark}.py").read_text(encoding="utf-8")
    told = ast.get_docstring(ast.parse(source)) or ""
    return f"### {benchmark}\n\n{kept.markdown(told, FENCE)}\n\n{PAGE.printed(name)}"


CLAIMS = {
    "data generation, 5 floats a sample, in process": ("generation", "in process"),
    "the same with 2 clients over TCP, including their startup": (
        "generation", "2 clients, start included"
    ),
    "training, FC [5, 5, 5, 1], batch 16, from the stored dataset": ("training", "physx"),
    "training, FC [3000, 64, 3], batch 16": ("training", "physx#2"),
    "5 ms of simulation per sample in a client, against the simulation alone": (
        "transport", "ratio#2"
    ),
    "predictions per second over TCP, 48 bytes, against a raw blocking ping-pong": (
        "transport", "1/get_prediction takes as many times as long"
    ),
    "environment steps per second, cartpole, acrobot, ant, against gym_jiminy 1.8.13": (
        "gym", "ratio", "ratio#3", "ratio#5"
    ),
    "a vector environment of 8 ants, 2 processes against 1; with `send` and `recv` of 4": (
        "gym", "2 processes against 1", "with send and recv"
    ),
    "a vector environment of 64 cartpoles, against Gymnasium's asynchronous and synchronous one": (
        "gym", "physx against AsyncVectorEnv", "physx against SyncVectorEnv"
    ),
    "online training: batches per second, against the slower of network and clients alone": (
        "online", "both against the slower alone"
    ),
    "training on twice as much data as memory, rows of 48 B and 48 kB, against reading the files": (
        "larger_than_memory", "training", "training#2"
    ),
}  # fmt: skip
"""What the tables show: a benchmark and the names of its values, as `measure.claim` prints them;
`#n` stands for the n-th value of that name, `1/` for the inverse."""
SHORT = 7
"""How many of them README.md shows."""


def value(name: str, of: str) -> str:
    """Return a value from a benchmark's kept output, with two digits."""
    wanted, _, place = of.removeprefix("1/").partition("#")
    text = (HERE / "figures" / f"{name}.txt").read_text(encoding="utf-8")
    found = re.findall(rf"^  {re.escape(wanted)}: ([^,]+), target", text, re.MULTILINE)
    number = float(found[int(place or 1) - 1])
    return f"{1 / number if of.startswith('1/') else number:#.2g}"


UNITS = {"reward": "reward", "speed": "speed in m/s", "success": "share of successes"}


def learned() -> str:
    """Return the table of docs/gym.md: what the policies of `learning` reached."""
    rows = [
        "| environment | range over seeds | on DART | on Pinocchio | training, s |",
        "|---|---|---|---|---|",
    ]
    for name in LEARNED:
        found = (HERE / "figures" / f"{name}.txt").read_text(encoding="utf-8")
        [env] = re.findall(r"^(physx/\S+), PPO on dart:", found, re.MULTILINE)
        times = [
            int(seconds) for seconds in re.findall(r"^\d+ on dart +(\d+) ", found, re.MULTILINE)
        ]
        ranges = re.findall(r"^(?:dart|pinocchio): (\w+) (\S+) to (\S+) over", found, re.MULTILINE)
        spans = " | ".join(f"{float(low):.3g} to {float(high):.3g}" for _, low, high in ranges)
        rows.append(f"| {env} | {UNITS[ranges[0][0]]} | {spans} | {min(times)} to {max(times)} |")
    return "\n".join(rows)


def tables() -> dict[Path, str]:
    """Return the tables that pages show between the marks of `with_table`."""
    short, long = ["| | physx / baseline |", "|---|---|"], ["| | | benchmark |", "|---|---|---|"]
    for place, (text, (name, *values)) in enumerate(CLAIMS.items()):
        numbers = ", ".join(value(name, of) for of in values)
        long.append(f"| {text} | {numbers} | {name} |")
        if place < SHORT:
            short.append(f"| {text} | {numbers} |")
    return {README: "\n".join(short), PAGE.path: "\n".join(long), GYM: learned()}


def with_table(page: Path, table: str) -> str:
    """Return a page's text with its table replaced by this one."""
    begin, end = "<!-- table: written by docs/figures.py -->", "<!-- end of table -->"
    before, _, rest = page.read_text(encoding="utf-8").partition(begin)
    return f"{before}{begin}\n\n{table}\n\n{end}{rest.partition(end)[2]}"


README, GYM = HERE.parent / "README.md", HERE / "gym.md"
PAGE = kept.Page(HERE / "figures.md", HERE / "figures", names, run, section)

if __name__ == "__main__":
    status = PAGE.main(__doc__ or "")
    for path, table in tables().items():
        path.write_text(with_table(path, table), encoding="utf-8")
    sys.exit(status)
