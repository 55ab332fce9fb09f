"""Buffers: which rows training batches hold while environments generate them."""
