from __future__ import annotations

import subprocess
import sys

import pytest

from physx_core import Network, Optimization, Transformation, plugins
from physx_core.errors import ComponentNotFoundError

pytestmark = pytest.mark.processes


@pytest.mark.parametrize(
    ("kind", "name", "class_name", "base"),
    [
        ("network", "torch/fc", "FC", Network),
        ("network", "torch/module", "ModuleNetwork", Network),
        ("optimization", "torch/default", "TorchOptimization", Optimization),
        ("transformation", "torch/default", "TorchTransformation", Transformation),
    ],
)
def test_components_are_found_by_name(kind, name, class_name, base):
    found = plugins.resolve(kind, name)
    assert found.__name__ == class_name
    assert issubclass(found, base)


def test_defaults_of_networks_resolve():
    network = plugins.resolve("network", "torch/fc")
    assert plugins.resolve("optimization", network.default_optimization)
    assert plugins.resolve("transformation", network.default_transformation)


def test_unknown_network_names_the_nearest():
    with pytest.raises(ComponentNotFoundError, match="fc") as caught:
        plugins.resolve("network", "torch/fcc")
    known = ["encoder_decoder", "fc", "graph", "module", "padded", "unet"]
    assert caught.value.known == known


def test_loading_the_plugin_does_not_import_torch():
    code = (
        "import sys, physx_torch\n"
        "from physx_core import plugins\n"
        "plugin = plugins.load('torch')\n"
        "assert {'network', 'optimization', 'transformation'} <= set(plugin.components)\n"
        "assert 'physx_torch.plugin' in sys.modules and 'torch' not in sys.modules\n"
        "assert 'FC' in dir(physx_torch)\n"
        "assert physx_torch.FC is plugins.resolve('network', 'torch/fc')\n"
        "assert 'torch' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_package_has_no_other_names():
    import physx_torch

    with pytest.raises(AttributeError, match="Nothing"):
        _ = physx_torch.Nothing
