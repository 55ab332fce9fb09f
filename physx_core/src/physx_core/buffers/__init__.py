"""Buffers: which rows the batches of a training hold while environments generate them."""
