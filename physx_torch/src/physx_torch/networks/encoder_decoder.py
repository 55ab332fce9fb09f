"""EncoderDecoder: fully connected layers through a short code in the middle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from physx_core.errors import ConfigError
from physx_torch.networks.fc import FC, layer_sizes


class EncoderDecoder(FC):
    """Fully connected encoder and decoder: all that the outputs depend on goes through a code.

    The form follows from the lists: symmetric, where no decoder is given and it mirrors the
    encoder; rectangular, where all hidden layers have one width, as in ``encoder=[300, 64, 64]``;
    asymmetric, where a decoder of one's own is given. Fields are read and predicted as in `FC`.
    For grids, a `UNet` with ``skip_merge=True`` is an encoder and decoder of convolutions.

    Attributes:
        code_size: Numbers in the code.
    """

    def __init__(
        self,
        encoder: Sequence[int],
        decoder: Sequence[int] | None = None,
        *,
        nb_outputs: int | None = None,
        **options: Any,
    ) -> None:
        """Make the layers.

        Args:
            encoder: Number of inputs, of neurons of each hidden layer, and of the code, for
                example ``[300, 64, 8]``.
            decoder: Number of neurons of each layer behind the code, the outputs last, for
                example ``[32, 30]``; None: those of the encoder in reverse order.
            nb_outputs: Number of outputs, where no decoder is given; None: as many as inputs.
            options: ``activation``, ``biases``, ``output_shape`` and the names of the fields as in
                `FC`.

        Raises:
            ConfigError: A list has the wrong content, or `nb_outputs` is given with a decoder.
        """
        own = layer_sizes(f"{type(self).__name__}.encoder", encoder, "[300, 64, 8]")
        if decoder is None:
            last = own[0] if nb_outputs is None else nb_outputs
            decoder = (*reversed(own[1:-1]), last)
        elif nb_outputs is not None:
            raise ConfigError(
                f"{type(self).__name__}.nb_outputs is given, but so is the decoder, whose last "
                "number says it."
            )
        super().__init__((*own, *decoder), **options)
        self.code_size = own[-1]
        self._split = 2 * len(own) - 3  # modules up to the code: linear layers and activations

    def encode(self, *inputs: torch.Tensor) -> torch.Tensor:
        """Return the codes of samples, shape (samples, code_size).

        Args:
            inputs: One tensor for each of `net_fields`, of shape (samples, *field shape).
        """
        code: torch.Tensor = self.layers[: self._split](self.joined(inputs))
        return code

    def decode(self, code: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Return the predictions for codes, as ``forward`` does.

        Args:
            code: Shape (samples, code_size).
        """
        return self.dealt_out(self.layers[self._split :](code))
