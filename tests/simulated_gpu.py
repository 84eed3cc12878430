"""A simulated device: tensors that lie in main memory but follow the rules of tensors on a GPU.

Within `simulated_gpu() as gpu`, the device `DEVICE` has such tensors. As on a GPU, an operation on tensors of two
devices is an error, and numpy cannot read them. `gpu.waits` records what the host would have to wait for (values and
shapes that Python asks for, copies to the host), `gpu.copies` the copies from the host to the device, and
`gpu.operations` counts what the device would be asked to run: torch's operations and the kernels of `backends.cuda`.

The device's name is torch's "meta", because a torch without CUDA knows no other device with gradients. Nothing else of
torch's meta tensors is used.
"""

import importlib.util
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

import tumble
from tumble import backends
from tumble.backends import cuda

PACKAGE = f"{Path(tumble.__file__).parent}{os.sep}"
"""Folder of the package; a checkout may be called `tumble`, too, with the tests in it."""
DEVICE = torch.device("meta")
"""The simulated device."""
WAITING = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_consecutive", "unique_dim"}
"""Operations whose result, or its shape, is a value that the host has to wait for."""
NO_WORK = {"empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided", "_local_scalar_dense"}
"""Operations that run nothing on a device, besides views."""
MIXING = {"copy_", "index", "index_put_", "_index_put_impl_", "_to_copy", "is_pinned", "set_"}
"""Operations that accept tensors of both devices."""


class OnDevice(torch.Tensor):
    """A tensor on the simulated device; `inner` holds its values."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "OnDevice":
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.shape, **layout, device=DEVICE)  # type: ignore
        made.inner = inner
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore

    def __repr__(self, **_: Any) -> str:
        return f"OnDevice({self.inner!r})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{function} outside the context of the simulated device")


class SimulatedGpu(TorchDispatchMode):
    """Context in which `DEVICE` is the simulated device."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[str] = []
        self.copies: list[str] = []
        self.operations = Counter[str]()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = function.__name__.partition(".")[0]
        tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
        if any(x.device.type == DEVICE.type and not isinstance(x, OnDevice) for x in tensors):
            # PyTorch fills it from Python values without telling anybody: its values would be arbitrary.
            raise RuntimeError(f"{name}: a tensor was made on the device from Python values; make it first, then move")
        there = [x for x in tensors if isinstance(x, OnDevice)]
        target = kwargs.get("device")
        target = torch.device(target).type if target is not None else None
        if there and name not in MIXING:
            here = [x for x in tensors if not isinstance(x, OnDevice) and x.dim()]
            if here:
                raise RuntimeError(f"{name}: tensors of {[tuple(x.shape) for x in here]} are not on the device")
        self._record(name, target, there, tensors)
        result = function._schema.returns[0].alias_info if function._schema.returns else None
        is_view = result is not None and not result.is_write
        if (there or target == DEVICE.type) and not is_view and name not in NO_WORK:
            self.operations[name] += 1
        if target == DEVICE.type:
            kwargs["device"] = torch.device("cpu")
        inner = tree_map(lambda x: x.inner if isinstance(x, OnDevice) else x, (args, kwargs))
        result = function(*inner[0], **inner[1])
        if function._schema.is_mutable and isinstance(args[0], torch.Tensor):
            return args[0]
        if target == DEVICE.type or (there and target is None and name != "_local_scalar_dense"):
            return tree_map(lambda x: OnDevice(x) if isinstance(x, torch.Tensor) else x, result)
        return result

    def _record(self, name: str, target: str | None, there: list[OnDevice], tensors: list[torch.Tensor]) -> None:
        """Note what an operation waits for or copies."""
        indexed = name.startswith(("index", "_index_put")) and any(
            x.dtype in (torch.bool, torch.uint8) for x in tensors[1:]
        )
        to_host = name == "_to_copy" and there and target == "cpu"
        back = name == "copy_" and len(there) == 1 and not isinstance(tensors[0], OnDevice)
        if there and (name in WAITING or (name == "index" and indexed) or to_host or back):
            self.waits.append(f"{name} in {_caller()}")
        to_device = name == "_to_copy" and target == DEVICE.type and not there
        mixed = name == "copy_" and len(there) == 1 and isinstance(tensors[0], OnDevice)
        foreign = name in ("index", "index_put_", "_index_put_impl_") and 0 < len(there) < len(tensors)
        if to_device or mixed or foreign:
            self.copies.append(f"{name} in {_caller()}")


def _caller() -> str:
    """File and function of the package that called torch."""
    frame: Any = sys._getframe(1)
    while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
        frame = frame.f_back
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno} {frame.f_code.co_name}" if frame else "a test"


class Kernels:
    """Those of a step are the ones for a GPU, which Warp runs on the CPU; the others are those of the CPU."""

    def __getattr__(self, verb: str) -> Callable[..., Any]:
        if not hasattr(cuda, verb):
            raise AttributeError(f"the kernels of a GPU include no {verb}")

        def call(*arguments: Any) -> Any:
            moving = (isinstance(x, torch.Tensor) and x.requires_grad for x in tree_flatten(arguments)[0])
            if verb == "adam" or (torch.is_grad_enabled() and any(moving)):
                return getattr(cuda if WITH_WARP else backends.load("reference"), verb)(*arguments)
            result = getattr(backends.load("cpu"), verb)(*on_host(arguments))
            return tree_map(lambda x: OnDevice(x) if isinstance(x, torch.Tensor) else x, result)

        return call


WITH_WARP = importlib.util.find_spec("warp") is not None
"""Without it the reference takes the place of the kernels."""


def on_host(values: Any) -> Any:
    """A tree of values with the tensors that hold those of the device."""
    return tree_map(lambda x: x.inner.detach() if isinstance(x, OnDevice) else x, values)


@contextmanager
def kernels_on(gpu: SimulatedGpu) -> Iterator[None]:
    """Warp's launches with the values of the device's tensors, counted as its operations."""
    if not WITH_WARP:
        yield
        return
    import warp

    from tumble.backends._warp import runtime

    launch, from_torch, sort = runtime.launch, warp.from_torch, warp.utils.radix_sort_pairs

    def launched(kernel: Any, threads: Any, *arguments: Any) -> None:
        gpu.operations[kernel.key] += 1
        launch(kernel, threads, *on_host(arguments))

    def sorted_pairs(*arguments: Any, **options: Any) -> None:
        gpu.operations["radix_sort_pairs"] += 1
        sort(*arguments, **options)

    with (
        patch.object(runtime, "launch", launched),
        patch.object(runtime, "stream", lambda device: warp.ScopedDevice("cpu")),
        patch.object(warp, "from_torch", lambda x, *rest, **options: from_torch(on_host(x), *rest, **options)),
        patch.object(warp.utils, "radix_sort_pairs", sorted_pairs),
    ):
        yield


@contextmanager
def simulated_gpu() -> Iterator[SimulatedGpu]:
    """The simulated device with its kernels."""
    choose: Callable[..., Any] = backends.choose
    gpu = SimulatedGpu()

    def chosen(device: torch.device, dtype: torch.dtype) -> Any:
        return Kernels() if device == DEVICE else choose(device, dtype)

    # These two make the tensor without a dispatch, which a meta tensor's values do not survive.
    make, make_like = torch.tensor, torch.Tensor.new_tensor

    def tensor(data: Any, *, device: Any = None, **options: Any) -> torch.Tensor:
        made = make(data, **options)
        return made if device is None else made.to(device)

    def new_tensor(like: torch.Tensor, data: Any, *, device: Any = None, **options: Any) -> torch.Tensor:
        if not isinstance(like, OnDevice):
            return make_like(like, data, **options)
        return make(data, **({"dtype": like.dtype} | options)).to(DEVICE)

    patches = (
        patch.object(backends, "choose", chosen),
        patch.object(torch, "tensor", tensor),
        patch.object(torch.Tensor, "new_tensor", new_tensor),
        patch.object(OnDevice, "new_tensor", new_tensor),
    )
    with ExitStack() as stack:
        for each in patches:
            stack.enter_context(each)
        stack.enter_context(kernels_on(gpu))
        yield stack.enter_context(gpu)
