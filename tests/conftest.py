"""Shared test set-up."""

from __future__ import annotations

import torch

# One thread: the problems are small, and several test processes share few cores.
torch.set_num_threads(1)
