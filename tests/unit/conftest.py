"""Lets the run-time checks of shapes and types ask whether a fake fits a protocol."""

import inspect
import typing

from slotfilm_dist import backend, contracts
from slotfilm_dist.nets import interface

for module in (backend, contracts, interface):
    for _, protocol in inspect.getmembers(module, inspect.isclass):
        if typing.Protocol in protocol.__bases__:
            typing.runtime_checkable(protocol)
