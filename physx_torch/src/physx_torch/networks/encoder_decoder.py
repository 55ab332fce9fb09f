"""EncoderDecoder: fully connected encoder and decoder with a code in between."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from physx_core.errors import ConfigError
from physx_torch.networks.fc import FC, check_layer_sizes


class EncoderDecoder(FC):
    """Fully connected encoder and decoder: outputs depend on inputs only through a code.

    By default, the decoder mirrors the encoder. Fields are read and predicted as in `FC`. For
    grids, a `UNet` with ``skip_merge=True`` is a convolutional encoder and decoder.

    Attributes:
        code_size: Number of values in the code.
    """

    def __init__(
        self,
        encoder: Sequence[int],
        decoder: Sequence[int] | None = None,
        *,
        nb_outputs: int | None = None,
        **options: Any,
    ) -> None:
        """Create the layers.

        Args:
            encoder: Numbers of inputs, of neurons of each hidden layer, and of code values, for
                example ``[300, 64, 8]``.
            decoder: Numbers of neurons of each layer after the code, ending with the outputs, for
                example ``[32, 30]``; None: those of the encoder in reverse order.
            nb_outputs: Number of outputs if there is no decoder; None: the number of inputs.
            options: ``activation``, ``biases``, ``output_shape`` and the names of the fields as in
                `FC`.

        Raises:
            ConfigError: If a list is invalid, or `nb_outputs` is combined with a decoder.
        """
        own = check_layer_sizes(f"{type(self).__name__}.encoder", encoder, "[300, 64, 8]")
        if decoder is None:
            last = own[0] if nb_outputs is None else nb_outputs
            decoder = (*reversed(own[1:-1]), last)
        elif nb_outputs is not None:
            raise ConfigError(f"{type(self).__name__}: set nb_outputs or the decoder, not both.")
        super().__init__((*own, *decoder), **options)
        self.code_size = own[-1]
        self._split = 2 * len(own) - 3  # modules up to the code: linear layers and activations

    def encode(self, *inputs: torch.Tensor) -> torch.Tensor:
        """Return the codes of samples, shape (samples, code_size).

        Args:
            inputs: One tensor for each of `net_fields`, of shape (samples, *field shape).
        """
        code: torch.Tensor = self.layers[: self._split](self.concatenate(inputs))
        return code

    def decode(self, code: torch.Tensor) -> torch.Tensor | list[torch.Tensor]:
        """Return the predictions for codes, in the form that ``forward`` returns.

        Args:
            code: Shape (samples, code_size).
        """
        return self.split_outputs(self.layers[self._split :](code))
