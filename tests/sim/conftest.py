"""Lets run-time checks ask whether a fake fits a protocol, and keeps torch to one thread on small tensors."""

import inspect
import typing

import torch

from slotfilm_dist import backend, contracts
from slotfilm_dist.nets import interface

torch.set_num_threads(1)
for module in (backend, contracts, interface):
    for _, protocol in inspect.getmembers(module, inspect.isclass):
        if typing.Protocol in protocol.__bases__:
            typing.runtime_checkable(protocol)
