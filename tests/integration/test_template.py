"""The template of a plugin is installed as a user would do it, and selected by name."""

import ast

import pytest

pytest.importorskip("torch")


def test_the_template_brings_an_environment_and_a_network(root, run, tmp_path):
    template = root / "examples/plugin_template"
    files = [template / "pyproject.toml", *template.rglob("*.py")]
    assert sum(len(file.read_text().splitlines()) for file in files) < 60
    packages = tmp_path / "packages"
    run(
        "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation",
        "--disable-pip-version-check", "--target", packages, template,
    )  # fmt: skip
    path = {"PYTHONPATH": str(packages)}
    physx = ("-m", "physx_core")
    listing = run(*physx, "plugins", **path).stdout
    assert "environment: template/cloud" in listing and "network: template/mlp" in listing
    generate = ("generate", "template/cloud", "--batch-nb", 4, "--batch-size", 25)
    run(*physx, *generate, "--environment.num-clients", 2, **path)
    train = ("train", "sessions/data_generation", "--network.network", "template/mlp")
    fit = ("--network.loss", "MSELoss", "--network.optimizer", "Adam", "--network.lr", "0.01")
    text = run(*physx, *train, *fit, "--epoch-nb", 2, "--batch-size", 20, **path).stderr
    assert "training loss" in text
    predict = ("predict", "sessions/training", "template/cloud", "--step-nb", 3)
    assert "3 steps with template/mlp" in run(*physx, *predict, **path).stderr


def test_the_template_imports_faces_only(root):
    internal = ("checkpoint", "dataset", "observers", "session", "statistics", "toy")
    for file in (root / "examples/plugin_template").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("physx_"):
                package, *rest = (node.module or "").split(".")
                assert not rest or (package == "physx_core" and len(rest) == 1)
                assert not rest or rest[0] not in internal
