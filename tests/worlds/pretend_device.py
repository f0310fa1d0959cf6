"""A CUDA device that is not there: tensors that say they are on it, meet no others, and count what leaves it.

A `PretendTensor` holds an ordinary tensor and says that it is on `cuda:0`. As on the device, an operation on it and on a
tensor of the CPU fails unless the latter is a single number; NumPy does not take it; numbers and tensors that are brought
back are counted.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch._C import _functorch  # pyright: ignore[reportAttributeAccessIssue]
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

DEVICE = torch.device("cuda:0")
_GET_DEVICE = vars(torch._C.TensorBase)["device"].__get__
_GET_IS_CUDA = vars(torch._C.TensorBase)["is_cuda"].__get__

_IN_NO_ORDER = ("cumsum", "cumsum_", "histc", "put", "put_", "kthvalue")
"""Operations on floats that torch has on a GPU only in no fixed order."""


@dataclass
class Transfers:
    """What went to and fro since `clear`."""

    scalars: int = 0
    """Numbers read back by `item`, `bool`, `float` ... one by one."""
    back: Counter[tuple[int, ...]] = field(default_factory=Counter)
    """Tensors brought to the CPU, by shape."""
    there: Counter[tuple[int, ...]] = field(default_factory=Counter)
    """Tensors brought to the device, by shape."""

    def clear(self) -> None:
        """Counts anew."""
        self.scalars = 0
        self.back.clear()
        self.there.clear()


class PretendTensor(Tensor):
    """A tensor that says it is on the device."""

    on_cpu: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> PretendTensor:
        """The same numbers, as if they were there."""
        made = Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            requires_grad=inner.requires_grad,
        )
        made.on_cpu = inner
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore[reportAssignmentType]

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        """`cuda:0`."""
        return DEVICE

    @property
    def is_cuda(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """True."""
        return True

    @property
    def is_cpu(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """False."""
        return False

    def __repr__(self, *, tensor_contents: object = None) -> str:
        """The numbers, and where they pretend to be."""
        return f"PretendTensor({self.on_cpu})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        """Outside `pretend_device` there is no device."""
        raise RuntimeError(f"{func}: the pretended device is gone")


@contextmanager
def pretend_device() -> Iterator[Transfers]:
    """While it is open, `cuda:0` is there, and `torch.cuda.is_available()` says so; gives the count of transfers."""
    transfers = Transfers()
    overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
    # In C++ a pretended tensor is the CPU's, and would be written into a module's own.
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    with (
        mock.patch.object(torch.cuda, "_lazy_init", lambda: None),
        mock.patch.object(torch.cuda, "is_available", lambda: True),
        _Operations(transfers) as operations,
        _Calls(transfers, operations),
    ):
        yield transfers
    torch.__future__.set_overwrite_module_params_on_conversion(overwrites)


class _Operations(TorchDispatchMode):
    """Every operation of torch, on the tensors that are held."""

    def __init__(self, transfers: Transfers) -> None:
        super().__init__()
        self.transfers = transfers
        self.goes_back = False
        """Whether derivatives are taken there: what is zero among them is made by torch itself, as if here."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Runs `func` where its tensors are."""
        kwargs = kwargs or {}
        tensors = [*_tensors(args), *_tensors(kwargs)]
        there = any(isinstance(x, PretendTensor) for x in tensors)
        name = func.overloadpacket.__name__
        device = kwargs.get("device")
        asked = None if device is None else torch.device(device).type
        moves = name == "copy_" and len(tensors) > 1
        if there and not moves:
            checked = tensors
            if name in ("index", "index_put", "index_put_") and isinstance(args[0], PretendTensor):
                # Indices are brought there by the operation itself.
                brought = [x for x in _tensors(args[1]) if _is_plain(x)]
                self.transfers.there.update(tuple(x.shape) for x in brought)
                checked = _tensors((args[0], *args[2:]))
            for x in checked:
                if _is_plain(x) and x.dim():
                    raise RuntimeError(
                        f"{func}: expected all tensors on one device, found {DEVICE} and cpu"
                    )
        if there:
            _as_cuda_would(name, args, kwargs)
        if name == "_local_scalar_dense":
            self.transfers.scalars += there
        held_args, held = _with(args, _held), _with(kwargs, _held)
        if asked is not None:
            held["device"] = torch.device("cpu")
        out = func(*held_args, **held)
        if name == "copy_" and moves:
            self._count(tensors[1], isinstance(tensors[0], PretendTensor))
            return args[0]
        if not there and asked != "cuda" and not (self.goes_back and not tensors):
            return out
        out = _with(out, PretendTensor)
        return return_and_correct_aliasing(func, args, kwargs, out) if there else out

    def _count(self, moved: Tensor, to_device: bool) -> None:
        if isinstance(moved, PretendTensor) != to_device:
            (self.transfers.there if to_device else self.transfers.back)[tuple(moved.shape)] += 1


class _Calls(TorchFunctionMode):
    """What torch does in C++ before an operation is dispatched: moving, making tensors of numbers and numbers of tensors."""

    def __init__(self, transfers: Transfers, operations: _Operations) -> None:
        super().__init__()
        self.transfers = transfers
        self.operations = operations

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """Does the same by operations."""
        kwargs = dict(kwargs or {})
        if func == _GET_DEVICE and _is_there(args[0]):
            return DEVICE
        if func == _GET_IS_CUDA:
            return _is_there(args[0])
        if func is torch.autograd.grad:
            with mock.patch.object(
                self.operations, "goes_back", any(map(_is_there, _tensors(args[0])))
            ):
                return func(*args, **kwargs)
        if func in (torch.tensor, torch.as_tensor, Tensor.new_tensor):
            return self._made(func, args, kwargs)
        if func in (Tensor.to, Tensor.cpu, Tensor.cuda):
            return self._moved(func, args, kwargs)
        if args and isinstance(args[0], PretendTensor):
            if func is Tensor.tolist:
                return self._brought(args[0], torch.device("cpu")).tolist()
            if func in (Tensor.numpy, Tensor.__array__):
                raise TypeError(f"can't convert {DEVICE} device type tensor to numpy; use .cpu()")
        return func(*args, **kwargs)

    def _made(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor:
        """A tensor of numbers, on the device that is asked for."""
        device = kwargs.pop("device", None)
        if func is Tensor.new_tensor:
            like, args = args[0], args[1:]
            device = DEVICE if device is None and _is_there(like) else device
            kwargs.setdefault("dtype", like.dtype)
            func = torch.tensor
        elif args and isinstance(args[0], PretendTensor) and device is None:
            device = DEVICE
        made = func(*args, **kwargs)
        return made if device is None else self._brought(made, torch.device(device))

    def _moved(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor:
        """What `to`, `cpu` and `cuda` give."""
        tensor, *rest = args
        device, dtype = kwargs.pop("device", None), kwargs.pop("dtype", None)
        if func is not Tensor.to:
            device = "cpu" if func is Tensor.cpu else DEVICE
        for x in rest:
            if isinstance(x, Tensor):
                device, dtype = DEVICE if _is_there(x) else torch.device("cpu"), x.dtype
            elif isinstance(x, torch.dtype):
                dtype = x
            elif isinstance(x, (str, torch.device)):
                device = x
        if device is not None:
            tensor = self._brought(tensor, torch.device(device))
        return tensor if dtype is None else Tensor.to(tensor, dtype, **kwargs)

    def _brought(self, tensor: Tensor, device: torch.device) -> Tensor:
        """The tensor where it is asked for, counted if it was not there."""
        is_there = _is_there(tensor)
        if is_there == (device.type == "cuda"):
            return tensor
        (self.transfers.back if is_there else self.transfers.there)[tuple(tensor.shape)] += 1
        return (
            tensor.on_cpu.clone()
            if isinstance(tensor, PretendTensor)
            else PretendTensor(tensor.clone())
        )


def _as_cuda_would(name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Fails and warns as CUDA's operations do where sums are to have one order, and those of a CPU do not."""
    if not torch.are_deterministic_algorithms_enabled():
        return
    value = args[0]
    if name.startswith("index_add") and not value.is_floating_point():
        # It is multiplied by the factor, and put into the sum after that.
        if isinstance(kwargs.get("alpha", 1), float):
            raise RuntimeError(f"{name}: expected scalar type Float but found {value.dtype}")
    weighted = name == "bincount" and len(_tensors([*args, *kwargs.values()])) > 1
    in_no_order = name in _IN_NO_ORDER and isinstance(value, Tensor) and value.is_floating_point()
    by_place = name == "median" and len(args) > 1
    if weighted or in_no_order or by_place:
        warnings.warn(f"{name} on CUDA does not have a deterministic implementation", stacklevel=2)


def _is_there(tensor: Tensor) -> bool:
    """True for a tensor on the device, within `vmap` and `jacfwd` too."""
    while _functorch.is_functorch_wrapped_tensor(tensor):
        tensor = _functorch.get_unwrapped(tensor)
    return isinstance(tensor, PretendTensor)


def _is_plain(x: object) -> bool:
    return isinstance(x, Tensor) and not isinstance(x, PretendTensor)


def _held(tensor: Tensor) -> Tensor:
    return tensor.on_cpu if isinstance(tensor, PretendTensor) else tensor


# Operations take and give tensors in tuples, lists and keywords, and in nothing else: torch's own functions for trees of
# any kind took four fifths of the time of what runs here.


def _tensors(value: object) -> list[Tensor]:
    """Those of what an operation takes."""
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, (tuple, list)):
        return [tensor for part in value for tensor in _tensors(part)]
    return []


def _with(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """What an operation takes or gives with other tensors."""
    if isinstance(value, Tensor):
        return change(value)
    if type(value) in (tuple, list):
        return type(value)(_with(part, change) for part in value)
    if type(value) is dict:
        return {name: _with(part, change) for name, part in value.items()}
    return value
