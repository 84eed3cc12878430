"""What the type checker of the tests refuses, on functions of the package that all other tests call rightly."""

import inspect
import sys

import pytest
import torch
from beartype.roar import BeartypeCallHintParamViolation, BeartypeCallHintReturnViolation
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tests import typechecker
from tumble import pipeline
from tumble.maths import images, se3


def test_a_wrong_type_and_a_wrong_shape_are_refused() -> None:
    for x in ([[0.0]], torch.zeros(2, 2, dtype=torch.int64), torch.zeros(2, 2)):
        with pytest.raises(BeartypeCallHintParamViolation):
            images.resize(x, 1, 1)
    with pytest.raises(BeartypeCallHintParamViolation):
        se3.SO3(torch.zeros(3))


def test_a_name_is_one_size_within_a_call_and_another_in_the_next() -> None:
    mask = torch.ones(3, 4, dtype=torch.bool)
    assert images.iou(mask, mask) == images.iou(mask.T, mask.T) == 1
    with pytest.raises(BeartypeCallHintParamViolation):
        images.iou(mask, mask.T)


def test_a_result_of_another_size_than_that_of_the_arguments_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert images.resize(torch.zeros(4, 4, 3), 2, 3).shape == (2, 3, 3)
    with pytest.raises(BeartypeCallHintReturnViolation):
        typechecker.checked(widened)(torch.zeros(2, 3))
    monkeypatch.setattr(functional, "interpolate", lambda x, *_, **__: x)
    with pytest.raises(BeartypeCallHintReturnViolation):
        images.resize(torch.zeros(4, 4, 3), 2, 3)


def test_a_name_that_only_type_checkers_import_stands_for_anything() -> None:
    def told(x: "Unheard", y: "int") -> "Unheard":  # type: ignore
        return x

    assert typechecker.checked(told)(1, 2) == 1
    with pytest.raises(BeartypeCallHintParamViolation):
        typechecker.checked(told)(1, "2")


def test_the_first_calls_in_a_test_are_checked_and_no_more() -> None:
    wrong = typechecker.checked(widened)
    for _ in range(typechecker.MAX_CALLS):
        with pytest.raises(BeartypeCallHintReturnViolation):
            wrong(torch.zeros(2, 3))
    assert wrong(torch.zeros(2, 3)).shape == (2, 6)


def widened(x: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return torch.cat([x, x], 1)


def test_every_function_and_every_dataclass_is_checked() -> None:
    """But for those that Warp compiles."""
    loaded = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == pipeline.__package__}
    modules = [module for name, module in loaded.items() if "_warp" not in name and not name.endswith("_jit")]
    for module in modules:
        own = [x for x in vars(module).values() if getattr(x, "__module__", "") == module.__name__]
        functions = [inspect.unwrap(x, stop=lambda f: hasattr(f, typechecker.DECORATOR)) for x in own if callable(x)]
        for function in filter(inspect.isfunction, functions):
            assert function.__name__ == "<lambda>" or hasattr(function, typechecker.DECORATOR), function
        for kind in filter(inspect.isclass, own):
            if "__dataclass_fields__" in vars(kind):
                assert hasattr(kind.__init__, typechecker.DECORATOR), kind
    assert len(modules) > 50
