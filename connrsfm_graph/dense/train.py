"""Training of the depth network on simulated surfaces.

The loss is the point-wise L1 distance of the network's log depth to the truth on the surface, both with zero mean, as
normals say nothing of the mean. Batches follow from the seed and the step alone, so that a training that was
interrupted goes on from its state file as if nothing had happened.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from connrsfm_graph.dense.checkpoint import Checkpoint, card_text, read_tensors
from connrsfm_graph.dense.network import DepthNetwork, make_network, predict, tensor
from connrsfm_graph.dense.simulated import HALF_SIZE, SLOPE, Batch, simulate
from connrsfm_graph.dense.window import Conditioned
from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.files import written_beside

HELD_OUT_NOISE = 0.2
"""Noise on the normals of the noisy half of the held-out surfaces."""
_RATE, _RATE_DEEP = 2e-3, 3e-4
"""Step sizes of the compact network, and of the deep ones, which diverge with more."""
_TRAINING, _HELD_OUT = 0, 1


@dataclass(frozen=True)
class TrainConfig:
    """How a network is trained."""

    variant: str = "compact"
    """Name in `network.VARIANTS`."""
    steps: int = 1600
    """Batches in all; the only setting that may change when a training goes on."""
    batch: int = 32
    """Surfaces per batch."""
    size: int = 64
    """Pixels per side of the images, a multiple of 32."""
    noise: float = 0.25
    """Largest standard deviation of the noise on the components of unit normals; 0 trains without augmentation."""
    rate: float | None = None
    """Adam's largest step size, None the variant's; steps are smaller at first, and fall to 0 over the last `decay` of
    the training."""
    decay: float = 0.4
    """Part of the steps over which the step size falls."""
    seed: int = 0
    """Seed of weights and surfaces."""
    every: int = 200
    """Steps between evaluations and saved states."""
    held_out: int = 256
    """Surfaces that it is evaluated on, never trained on."""

    def __post_init__(self) -> None:
        if self.size < 64 or self.size % 32:
            raise InputError(f"image size {self.size}, expected a multiple of 32 from 64")
        for name in ("steps", "batch", "every", "held_out"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}, expected at least 1")
        if not 0.0 <= self.noise <= 1.0 or not self.step_size > 0.0 or not 0.0 < self.decay <= 1.0 or self.seed < 0:
            raise InputError("noise and decay must be from 0 to 1, rate above 0 and seed not negative")

    @property
    def step_size(self) -> float:
        """Adam's largest step size."""
        return self.rate if self.rate is not None else _RATE if self.variant == "compact" else _RATE_DEEP


def train(
    config: TrainConfig,
    out: str | Path,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> Checkpoint:
    """Train a network; write its checkpoint to `out`, and a card in Markdown beside it.

    Until it is done there is a state file OUT.state, from which a training that was interrupted goes on.

    Args:
        config: settings; where OUT.state exists, those it was made with, but for the steps.
        out: name of the checkpoint, also written after every evaluation.
        device: torch's name of the device.
        progress: called with (steps done, steps).
        report: called with one line per evaluation.

    Raises:
        InputError: the state file is none, or of other settings.
        ComputationError: the loss is no longer finite.
    """
    out = Path(out)
    state_file = out.with_name(out.name + ".state")
    network = make_network(config.variant, config.seed).to(device)
    optimiser = torch.optim.Adam(network.parameters(), lr=config.step_size)
    step, history = 0, []
    if state_file.exists():
        state = read_tensors(state_file)
        if {**state.get("configuration", {}), "steps": 0} != {**asdict(config), "steps": 0}:
            raise InputError(f"{state_file}: state of a training with other settings; remove it to begin anew")
        network.load_state_dict(state["weights"])
        optimiser.load_state_dict(state["optimiser"])
        step, history = state["step"], state["history"]
    while step < config.steps:
        for group in optimiser.param_groups:
            group["lr"] = config.step_size * _schedule(step, config)
        batch = simulate(config.batch, config.size, (_TRAINING, config.seed, step), (0.0, config.noise))
        loss = _step(network, optimiser, batch, device)
        step += 1
        if not math.isfinite(loss):
            raise ComputationError(f"the loss is not finite after {step} steps; begin anew with a smaller rate")
        if progress is not None:
            progress(step, config.steps)
        if step % config.every == 0 or step == config.steps:
            clean, noisy = (held_out_error(network, config, noise, device) for noise in (0.0, HELD_OUT_NOISE))
            history.append({"step": step, "loss": loss, "clean": clean, "noisy": noisy})
            if report is not None:
                report(f"step {step}: loss {loss:.4f}, held-out {100 * clean:.2f} %, noisy {100 * noisy:.2f} %")
            with written_beside(state_file) as part:
                content = {
                    "configuration": asdict(config),
                    "step": step,
                    "history": history,
                    "weights": network.state_dict(),
                    "optimiser": optimiser.state_dict(),
                }
                torch.save(content, part)
            card = {"configuration": asdict(config), "step": step, "history": history}
            checkpoint = Checkpoint(network, config.variant, config.size, SLOPE[1] * HALF_SIZE[1], card)
            checkpoint.save(out)
    state_file.unlink(missing_ok=True)
    checkpoint = Checkpoint.load(out)
    with written_beside(out.with_suffix(".md")) as part:
        part.write_text(card_text(checkpoint), encoding="utf-8")
    return checkpoint


def relative_error(log_depth: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Mean relative error of depth on surfaces (B, S, S), each scaled so that the mean log depths agree."""
    pixels = mask.sum(axis=(1, 2))
    difference = np.where(mask, log_depth - truth, 0.0)
    difference -= (difference.sum(axis=(1, 2)) / pixels)[:, None, None]
    return float(np.mean((np.abs(np.expm1(difference)) * mask).sum(axis=(1, 2)) / pixels))


def held_out_error(network: DepthNetwork, config: TrainConfig, noise: float, device: str = "cpu") -> float:
    """Mean relative error of depth on the surfaces held out, with noise of this standard deviation on the normals."""
    errors, counts = [], []
    for start in range(0, config.held_out, config.batch):
        count = min(config.batch, config.held_out - start)
        batch = simulate(count, config.size, (_HELD_OUT, start), (noise, noise))
        log_depth = predict(network, batch.normals, batch.mask, device)
        errors.append(relative_error(log_depth, batch.log_depth, batch.mask))
        counts.append(count)
    return float(np.average(errors, weights=counts))


def _step(network: DepthNetwork, optimiser: torch.optim.Optimizer, batch: Batch, device: str) -> float:
    """One step of the optimiser; the loss before it."""
    conditioned = Conditioned.of(batch.normals, batch.mask)
    mask = torch.from_numpy(batch.mask.astype(np.float32)).to(device)
    target = torch.from_numpy(conditioned.reduced(batch.log_depth).astype(np.float32)).to(device)
    pixels = mask.sum(dim=(1, 2), keepdim=True)
    network.train()
    difference = (network(tensor(conditioned.images, device)) - target) * mask
    difference = (difference - difference.sum(dim=(1, 2), keepdim=True) / pixels) * mask
    loss = (difference.abs().sum(dim=(1, 2), keepdim=True) / pixels).mean()
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    return float(loss.detach())


def _schedule(step: int, config: TrainConfig) -> float:
    """Factor on the step size: a rise over at most 100 steps, a plateau, and a fall to 0."""
    rise = min(1.0, (step + 1) / min(100, config.steps))
    return rise * min(1.0, (config.steps - step) / (config.decay * config.steps))
