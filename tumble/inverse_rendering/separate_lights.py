"""Baseline of stage 3 after ReCap (Li et al. 2025): a light of its own for every block of consecutive frames.

Nothing is known of the motion of the light. Each block has an environment map in the object frame, in which the light
is assumed to be static while the block lasts; the material is shared by all blocks. Everything else is `decompose`, so
that one block of frames under a light that is fixed to the object is our method.
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from tumble.engine import State, optim
from tumble.inverse_rendering import decompose
from tumble.inverse_rendering.decompose import Inputs
from tumble.scene import Asset, Environment

VERSION = 1


@dataclass(frozen=True)
class Config:
    """Settings of the baseline."""

    base: decompose.Config = field(default_factory=decompose.Config)
    """Everything but the lights. Its poses are not optimised."""
    lights: int = 10
    """Number of blocks; if there are fewer frames, every frame is a block."""


@dataclass(frozen=True)
class Params(decompose.Params):
    """Parameters of stage 3 with more lights; `environment` is that of the first block."""

    others: dict[str, Environment] = field(default_factory=dict)
    """Environment of each other block, object frame, by the block's number."""


def length(cfg: Config, inputs: Inputs) -> int:
    """Number of steps."""
    return cfg.base.steps


def init(cfg: Config, inputs: Inputs, rng: torch.Generator) -> State:
    """The initial state of `decompose`, with a copy of its light for every block."""
    if cfg.base.rates.poses:
        raise ValueError("this baseline does not optimise poses: its learning rate of poses must be 0")
    state = decompose.init(cfg.base, _in_object_frame(inputs), rng)
    others = {str(block): state.params.environment for block in range(1, len(_blocks(cfg, inputs)))}
    state.params = optim.leaves(Params(**vars(state.params), others=others))
    rates = decompose.learning_rates(cfg.base, state.params.material)
    rates |= {"others": cfg.base.rates.light} if others else {}
    state.optimizer = optim.adam(state.params, rates)
    return state


def step(cfg: Config, inputs: Inputs, state: State) -> dict[str, Tensor | float]:
    """One step of `decompose` on a random frame under the light of its block."""
    blocks = _blocks(cfg, inputs)
    block = 0
    if len(blocks) > 1:
        frame = int(torch.randint(len(inputs.capture), (1,), generator=state.rng))
        block = next(number for number, frames in enumerate(blocks) if frame in frames)
    state.params = _under_light(state.params, block)
    terms = decompose.step(cfg.base, _of_frames(_in_object_frame(inputs), blocks[block]), state)
    state.params = _under_light(state.params, block)
    return terms


@torch.no_grad()
def finish(cfg: Config, inputs: Inputs, state: State) -> Asset:
    """The relightable asset; its light is the mean of all, each rotated to the env frame of its middle frame."""
    blocks, trajectory = _blocks(cfg, inputs), inputs.refined.trajectory
    assets = []
    for block in range(len(blocks)):
        inner = replace(state, params=_under_light(state.params, block))
        assets.append(decompose.finish(cfg.base, _in_object_frame(inputs), inner))
    rows = max(asset.environment.log_radiance.shape[0] for asset in assets)
    lights = [
        asset.environment.resampled(rows, 2 * rows).rotated(trajectory.R_env_obj[frames[len(frames) // 2]]).radiance
        for asset, frames in zip(assets, blocks, strict=True)
    ]
    environment = Environment.from_radiance(torch.stack(lights).mean(0))
    return replace(assets[0], environment=environment, trajectory=trajectory)


def _blocks(cfg: Config, inputs: Inputs) -> list[range]:
    """Frames of each block; all have nearly the same number."""
    t = len(inputs.capture)
    n = min(cfg.lights, t)
    return [range(-(-t * block // n), -(-t * (block + 1) // n)) for block in range(n)]


def _in_object_frame(inputs: Inputs) -> Inputs:
    """The inputs as if the light was fixed to the object."""
    capture, refined = inputs.capture, inputs.refined
    trajectory = replace(refined.trajectory, light="object", light_turns=None)
    return Inputs(replace(capture, light="object", trajectory=None), replace(refined, trajectory=trajectory))


def _of_frames(inputs: Inputs, frames: range) -> Inputs:
    """The inputs reduced to some frames."""
    capture, refined = inputs.capture, inputs.refined
    if len(frames) == len(capture):
        return inputs
    trajectory = refined.trajectory.select(list(frames))
    return Inputs(capture.select(list(frames)), replace(refined, trajectory=trajectory))


def _under_light(params: Params, block: int) -> Params:
    """The parameters with the light of a block exchanged with that of the first one; the second time, back again."""
    if block == 0:
        return params
    key = str(block)
    others = params.others | {key: params.environment}
    return replace(params, environment=params.others[key], others=others)
