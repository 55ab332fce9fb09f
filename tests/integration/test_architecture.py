"""docs/architecture.md names files and rooms that exist, docs/durability.md tests."""

import re

PACKAGES = (
    "core",
    "sim",
    "testing",
    "formats",
    "dart",
    "mujoco",
    "torch",
    "rerun",
    "viser",
    "gym",
    "remote",
    "cluster",
    "agree",
    "identify",
)


def test_every_file_on_the_ways_exists(root):
    text = (root / "docs/architecture.md").read_text()
    places = re.findall(rf"`({'|'.join(PACKAGES)}):([\w/]+\.py)`", text)
    assert len(places) > 30
    for package, file in places:
        assert (source(root, package) / file).is_file(), f"{package}:{file}"


def test_the_tree_shows_every_room(root):
    text = (root / "docs/architecture.md").read_text()
    tree = re.search(r"## Source tree\n\n```\n(.*?)```", text, re.S)[1]
    for package in PACKAGES:
        part = tree.split(f"physx_{package}/\n")[1].split("\n\n")[0]
        folders = {path for path in source(root, package).rglob("*/") if any(path.glob("*.py"))}
        drawn = set(re.findall(r"(\w+)/", part))
        for folder in folders:
            assert folder.name in drawn, folder


def test_every_promise_names_a_test(root):
    text = (root / "docs/durability.md").read_text()
    named = set(re.findall(r"`(test_\w+)`", text))
    assert len(named) > 5
    assert named <= {path.stem for path in (root / "tests").rglob("test_*.py")}


def source(root, package):
    return root / f"physx_{package}/src/physx_{package}"
