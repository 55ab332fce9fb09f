"""DatasetConfig: where samples are stored, and how and which of them are read."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path

from physx_core.config import MODES, WRONG, at_least, configuration
from physx_core.normalization import check_methods
from physx_core.views.view import View


@configuration
class DatasetConfig:
    """Where samples are stored, and how and which of them are read."""

    existing_dir: str | Path | None = None
    """Folder of an existing session or dataset to read; it is never modified."""
    mode: str = field(default="training", metadata={"choices": (*MODES, WRONG)})
    """Mode to write or read: "training", "validation" or "prediction"; "wrong", with the samples
    that `check_sample` rejected, can only be read."""
    max_file_size: float = at_least(1e-6, 0.25)
    """Size of a partition in GB."""
    writers: str = field(default="server", metadata={"choices": ("server", "clients")})
    """Who writes the rows in data generation: "server", the run's own process, or "clients", each
    client the rows of its episodes, which must be independent. The clients must then share the
    dataset's folder. The dataset is the same; use this for data rates that the run's connection
    cannot carry."""
    shuffle: bool = True
    """Read each epoch in a new random order; otherwise in the order of writing."""
    view: View = field(default_factory=View)
    """Which of the samples to learn from, in which form and order, and which of them to hold back
    for validation if the dataset has no mode "validation"; the others define the normalization."""
    normalize: bool | dict[str, str] = False
    """Normalize fields to mean 0 and standard deviation 1 for networks. A table says how, by field:
    "component", each component for itself; "channel", each entry of the axis "channel", all others
    together; "field", all components together; with "log-" in front, the natural logarithm of
    positive values; "increment", its change since the field of the network's inputs that is the
    same quantity, or since FIELD with "increment:FIELD"; "none", not at all. A field that it does
    not name, and with True every field, is normalized like the one that it is `like`, by that one's
    statistics; else by "channel", or by "field" without channels, if it has two or more named axes;
    else by "component"."""
    recompute_normalization: bool = False
    """Recompute mean and standard deviation from the stored rows instead of using the stored
    values."""

    def __post_init__(self) -> None:
        """Check the methods of normalization.

        Raises:
            ConfigError: If there is no such method.
        """
        check_methods("DatasetConfig.normalize", self.normalize)
