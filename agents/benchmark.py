"""Speed, measured side by side with peers in one process: ``roadgym benchmark``.

Each case times two things in turn, several times, and states the median of the ratios pair by pair, so that a machine whose
speed drifts says the same as a quiet one. Everything goes through the public interface, on the default plant, with staggered
episodes so that resets occur; the peers are Gymnasium's CartPole, NumPy's normal draws and stable-baselines3's DummyVecEnv.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from roadgym import ENVIRONMENT_ID
from roadgym.installation import needs
from roadgym.plant import Plant
from roadgym.resolution import LARGEST_ANGLE
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

REPEATS = 7


@dataclasses.dataclass(frozen=True)
class Result:
    """One line of the benchmark.

    Attributes:
        name: what was measured.
        ours, peer: seconds for one unit of work, medians; bytes where the name says so.
        ratio: median over the pairs.
        spread: smallest and largest ratio of the pairs.
        reach: what the ratio should reach, in words.
        good: does it.
    """

    name: str
    ours: float
    peer: float
    ratio: float
    spread: tuple[float, float]
    reach: str
    good: bool


def seconds(work: Callable[[], Any], least: float = 0.05) -> float:
    """Seconds for one call of ``work``, from as many calls as take ``least`` seconds."""
    calls = 1
    while True:
        begin = time.perf_counter()
        for _ in range(calls):
            work()
        taken = time.perf_counter() - begin
        if taken >= least:
            return taken / calls
        calls = max(2 * calls, int(calls * least / max(taken, 1e-9)))


def side_by_side(
    name: str,
    ours: Callable[[], float],
    peer: Callable[[], float],
    reach: str,
    good: Callable[[float], bool],
    *,
    peer_over_ours: bool = False,
    repeats: int = REPEATS,
) -> Result:
    """Time two things in turn; the ratio is ours over the peer's, or the other way round."""
    ours(), peer()  # warm up
    pairs = np.array([(ours(), peer()) for _ in range(repeats)])
    ratios = pairs[:, 1] / pairs[:, 0] if peer_over_ours else pairs[:, 0] / pairs[:, 1]
    ratio = float(np.median(ratios))
    spread = float(ratios.min()), float(ratios.max())
    own, other = np.median(pairs, axis=0).tolist()
    return Result(name, own, other, ratio, spread, reach, good(ratio))


def batch(num_envs: int, **options: Any) -> Callable[[], Any]:
    """A function that steps a batch once, its episodes staggered."""
    envs = QuarterCarVectorEnv(num_envs, **options)
    envs.reset(seed=0)
    envs.plant.elapsed_steps = np.arange(num_envs) % 500
    actions = np.full((num_envs, 1), 0.3, np.float32)
    return lambda: envs.step(actions)


def vector_step() -> Result:
    """Environment steps of the batch against CartPole's own batch."""
    peer = gymnasium.make_vec("CartPole-v1", num_envs=4096)
    peer.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 2, 4096)
    step = batch(4096, threads=1)
    return side_by_side(
        "step of 4096 environments, CartPole's batch over ours",
        lambda: seconds(step),
        lambda: seconds(lambda: peer.step(actions)),
        ">= 3",
        lambda ratio: ratio >= 3,
        peer_over_ours=True,
    )


def substep() -> Result:
    """One substep of one car against one normal draw of NumPy's."""
    few, many = 2, 34
    # of one length: the shorter ones are, the more digits they ask for
    short, long = (batch(4096, threads=1, substeps=count, control_interval=LARGEST_ANGLE * count) for count in (few, many))
    generator, buffer = np.random.default_rng(0), np.empty(4096)
    return side_by_side(
        "substep of one car (road, car, noise, squares) over one standard_normal",
        lambda: (seconds(long) - seconds(short)) / (many - few) / 4096,
        lambda: seconds(lambda: generator.standard_normal(out=buffer)) / 4096,
        "<= 0.25",
        lambda ratio: ratio <= 0.25,
    )


def threads() -> Result:
    """Two threads against one."""
    one, two = batch(65536, threads=1), batch(65536, threads=2)
    return side_by_side(
        "65536 environments, one thread over two",
        lambda: seconds(two),
        lambda: seconds(one),
        ">= 1.7",
        lambda ratio: ratio >= 1.7,
        peer_over_ours=True,
    )


def single(identifier: str, action: Any) -> Callable[[], Any]:
    """A function that steps a single environment once, and resets it where that is due."""
    env = gymnasium.make(identifier)
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def single_step() -> Result:
    """The single environment through `gymnasium.make` against CartPole."""
    ours, peer = single(ENVIRONMENT_ID, np.array([0.3], np.float32)), single("CartPole-v1", 0)
    return side_by_side(
        "step of a single environment over CartPole's",
        lambda: seconds(ours),
        lambda: seconds(peer),
        "<= 0.9",
        lambda ratio: ratio <= 0.9,
    )


def adapter() -> Result:
    """The stable-baselines3 adapter against DummyVecEnv of as many single environments."""
    with needs("train"):
        from stable_baselines3.common.vec_env import DummyVecEnv
    from .vec_env import QuarterCarVecEnv

    ours = QuarterCarVecEnv(64)
    peer = DummyVecEnv([lambda: gymnasium.make(ENVIRONMENT_ID)] * 64)
    actions = np.zeros((64, 1), np.float32)
    ours.reset(), peer.reset()
    return side_by_side(
        "stable-baselines3, 64 environments, DummyVecEnv over ours",
        lambda: seconds(lambda: ours.step(actions)),
        lambda: seconds(lambda: peer.step(actions)),
        ">= 10",
        lambda ratio: ratio >= 10,
        peer_over_ours=True,
    )


def share_of_training() -> Result:
    """Wall time inside the environment while PPO trains, over the whole."""
    from .training import load_hyperparameters, make_model

    parameters = load_hyperparameters("ppo") | {"n_envs": 64}
    model = make_model("ppo", parameters, {"road": "multiplicative"}, 0, None)
    wrapped = model.get_env()
    assert wrapped is not None
    envs = wrapped.unwrapped  # without the normalisation of rewards, which is stable-baselines3's
    inside = 0.0
    plain = envs.step_wait

    def timed() -> Any:
        nonlocal inside
        begin = time.perf_counter()
        result = plain()
        inside += time.perf_counter() - begin
        return result

    envs.step_wait = timed  # type: ignore[method-assign]

    def learn() -> float:
        nonlocal inside
        inside, begin = 0.0, time.perf_counter()
        model.learn(16_384)
        learn.whole = time.perf_counter() - begin  # type: ignore[attr-defined]
        return inside

    return side_by_side(
        "environment's share of PPO's wall time, 64 environments",
        learn,
        lambda: learn.whole,  # type: ignore[attr-defined]
        "<= 0.1",
        lambda ratio: ratio <= 0.1,
        repeats=3,
    )


def euler_maruyama() -> Result:
    """One sample of the paper's Fig. 7 with its statistics, one thread, against one normal draw of NumPy's."""
    from analysis.paper.euler_maruyama import simulate
    from roadgym import WhiteSpeedNoise

    samples = 20_000_000  # those of the paper at one speed
    generator, buffer = np.random.default_rng(0), np.empty(4096)

    def run() -> float:
        begin = time.perf_counter()
        simulate(
            "harmonic",
            WhiteSpeedNoise(intensity=0.2),
            damping=0.1,
            speed=[1.0],
            form="ito",
            samples=samples,
            histogram=(-6.0, 10.0, 160),
            threads=1,
        )
        return (time.perf_counter() - begin) / samples

    return side_by_side(
        "Euler-Maruyama sample with its statistics over one standard_normal",
        run,
        lambda: seconds(lambda: generator.standard_normal(out=buffer)) / 4096,
        "<= 1",
        lambda ratio: ratio <= 1,
        repeats=5,
    )


def memory() -> Result:
    """Bytes of state for each environment of a million."""
    plant = Plant(make_task(), 1_000_000)
    each = plant.nbytes / plant.num_envs
    return Result("state of an environment in a batch of 10^6, bytes", each, 256.0, each, (each, each), "<= 256", each <= 256)


def process_start() -> Result:
    """From the start of a process to the first step, with a warm compilation cache."""
    code = "import gymnasium as g; e = g.make({!r}); e.reset(seed=0); e.step(e.action_space.sample())"

    def run(identifier: str) -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", code.format(identifier)], check=True)
        return time.perf_counter() - begin

    return side_by_side(
        "from process start to the first step over CartPole's",
        lambda: run("roadgym:" + ENVIRONMENT_ID),
        lambda: run("CartPole-v1"),
        "<= 3",
        lambda ratio: ratio <= 3,
        repeats=5,
    )


CASES: dict[str, Callable[[], Result]] = {
    "vector_step": vector_step,
    "substep": substep,
    "threads": threads,
    "single_step": single_step,
    "adapter": adapter,
    "share_of_training": share_of_training,
    "memory": memory,
    "euler_maruyama": euler_maruyama,
    "process_start": process_start,
}


def scaling() -> list[dict[str, float]]:
    """Nanoseconds for one environment step over the number of environments and of substeps, one thread."""
    rows = []
    for num_envs in (1, 10, 100, 1_000, 10_000, 100_000, 1_000_000):
        rows.append(
            {"environments": num_envs, "substeps": 2, "nanoseconds": seconds(batch(num_envs, threads=1)) / num_envs * 1e9}
        )
    for substeps in (1, 2, 4, 8, 16, 32):
        step = batch(4096, threads=1, substeps=substeps, control_interval=LARGEST_ANGLE * substeps)
        rows.append({"environments": 4096, "substeps": substeps, "nanoseconds": seconds(step) / 4096 * 1e9})
    return rows


def scaling_table(rows: list[dict[str, float]]) -> str:
    """The scaling as text."""
    lines = ["environments  substeps  ns for a step of one environment"]
    lines += [f"{row['environments']:12g}  {row['substeps']:8g}  {row['nanoseconds']:32.3g}" for row in rows]
    return "\n".join(lines)


def draw_scaling(rows: list[dict[str, float]], path: Path) -> None:
    """Time of a batch's step over its size, and of one environment's over the substeps, with lines of slope one."""
    with needs("report"):
        from matplotlib.figure import Figure
    from .figure_style import save_figure

    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    sizes, substeps = figure.subplots(1, 2)
    by_size = [(row["environments"], row["nanoseconds"] * row["environments"] / 1e3) for row in rows[:-6]]
    by_substep = [(row["substeps"], row["nanoseconds"]) for row in rows[-6:]]
    x, y = zip(*by_size, strict=True)
    sizes.loglog(x, y, "o-", color="#0072B2")
    sizes.loglog(x[-4:], [y[-1] * size / x[-1] for size in x[-4:]], ":", color="black", label="linear")
    sizes.set_xlabel("environments in the batch")
    sizes.set_ylabel("time of a step of the batch, \u00b5s")
    sizes.legend()
    x, y = zip(*by_substep, strict=True)
    substeps.plot(x, y, "o-", color="#0072B2")
    substeps.set_xlabel("substeps in a control interval")
    substeps.set_ylabel("time of a step of one environment of 4096, ns")
    substeps.set_ylim(bottom=0)
    for axis in (sizes, substeps):
        axis.grid(visible=True, linewidth=0.3)
    save_figure(figure, path)


def quantity(value: float) -> str:
    """Seconds in a unit that suits them; plain numbers from 1 up are bytes."""
    for unit, size in (("ns", 1e-9), ("us", 1e-6), ("ms", 1e-3)):
        if value < 1000 * size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.3g} s" if value < 30 else f"{value:.0f} B"


def table(results: list[Result]) -> str:
    """The benchmark as text."""
    head = ("what", "ours", "peer", "ratio", "(min - max)", "reach", "")
    lines = [head]
    for result in results:
        low, high = result.spread
        lines.append(
            (
                result.name,
                quantity(result.ours),
                quantity(result.peer),
                f"{result.ratio:.3g}",
                f"({low:.3g} - {high:.3g})",
                result.reach,
                "ok" if result.good else "missed",
            )
        )
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0])] + [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)])
        for line in lines
    )
