"""Train the judge of parts and measure it on seeds it has not seen.

python benchmarks/part_classifier/train.py                      # about 15 minutes of one core; goes on after a kill
python benchmarks/part_classifier/train.py --measure            # accuracy per part of the packed weights
python benchmarks/part_classifier/train.py --words fine         # bodies and parts of the finer prior, in `fine`
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import avg_pool2d, cross_entropy, pad

sys.path.insert(0, str(Path(__file__).parent))

from model import NOTHING, PartNetwork, load_classifier, save_classifier  # noqa: E402
from pictures import SEEN_SEED, UNSEEN_SEED, Views, make_views  # noqa: E402

from fd_mitsuba.prior.data.catalogue import COARSE, FINE, Catalogue  # noqa: E402

FOLDER = Path(__file__).parent
_BATCH = 96
_FIRST_BODIES = 27
CATALOGUES = {"coarse": COARSE, "fine": FINE}


def joined(many: list[Views]) -> Views:
    """All views as one."""
    columns = ("before", "after", "label", "body", "closeup", "blob")
    return Views(*(np.concatenate([getattr(views, name) for views in many]) for name in columns))


def kept_views(folder: Path, number: int, catalogue: Catalogue) -> Views:
    """The views of training body `number`, made once and then read from `folder/views`."""
    path = folder / "views" / f"{number:05d}.npz"
    if path.is_file():
        with np.load(path) as data:
            return Views(**data)
    names = list(catalogue.body_weights)
    views = make_views(names[number % len(names)], SEEN_SEED + number, catalogue)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".tmp.npz")
    np.savez(unfinished, **vars(views))
    os.replace(unfinished, path)
    return views


def batch(
    views: Views, rng: np.random.Generator, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A random batch with mirror images, and noise and blur on the picture after: a sample of a prior has both."""
    chosen = rng.integers(len(views), size=_BATCH)
    before, after = (torch.from_numpy(column[chosen]).float() / 127 for column in (views.before, views.after))
    mirrored = torch.from_numpy(rng.random(_BATCH) < 0.5)[:, None, None, None]
    sign = torch.tensor([-1.0, 1, 1, 1])[:, None, None]
    before, after = (torch.where(mirrored, (sign * x).flip(3), x) for x in (before, after))
    blur = torch.from_numpy(rng.uniform(0, 0.8, _BATCH) * (rng.random(_BATCH) < 0.5)).float()[:, None, None, None]
    after = after + blur * (avg_pool2d(pad(after, (1, 1, 1, 1), mode="replicate"), 3, 1) - after)
    noise = torch.from_numpy(rng.uniform(0, 0.1, _BATCH) * (rng.random(_BATCH) < 0.6)).float()[:, None, None, None]
    after = after + noise * torch.randn(after.shape, generator=generator)
    return before, after, torch.from_numpy(views.label[chosen])


def train(folder: Path, bodies: int, steps: int, seconds: float, catalogue: Catalogue = COARSE) -> None:
    """Train while `bodies` random bodies come in; writes weights now and then, goes on from a checkpoint.

    Args:
        folder: for the weights; `checkpoint.pt` and `views` lie in it while the training is not finished.
        catalogue: whose bodies and parts.
        steps, seconds: what comes first ends it; the learning rate falls with the larger of both shares.
    """
    torch.manual_seed(0)
    classes = (*catalogue.part_weights, NOTHING)
    network = PartNetwork(classes).to(memory_format=torch.channels_last)
    average = PartNetwork(classes)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=0.02, fused=True)
    step, spent, checkpoint = 0, 0.0, folder / "checkpoint.pt"
    folder.mkdir(parents=True, exist_ok=True)
    if checkpoint.is_file():
        state = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimiser.load_state_dict(state["optimiser"])
        step, spent = state["step"], state["seconds"]
    rng, generator = np.random.default_rng([SEEN_SEED, step]), torch.Generator().manual_seed(step)
    made: list[Views] = []
    started = saved = time.monotonic()
    pool, smooth, progress = None, None, step / steps
    while (progress := max(progress, step / steps, (spent + time.monotonic() - started) / seconds)) < 1:
        wanted = min(bodies, _FIRST_BODIES + int(1.2 * step / steps * bodies))
        if len(made) < wanted:
            made += [kept_views(folder, number, catalogue) for number in range(len(made), wanted)]
            pool = joined(made)
        before, after, label = batch(pool, rng, generator)
        rate = 2e-3 * min(1.0, (step + 1) / 60) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * progress)))
        for group in optimiser.param_groups:
            group["lr"] = float(rate)
        loss = cross_entropy(network(before, after), label, label_smoothing=0.02)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        step += 1
        decay = min(0.99, step / (step + 10))
        with torch.no_grad():
            state = network.state_dict()
            for key, value in average.state_dict().items():
                value.lerp_(state[key], 1 - decay) if value.is_floating_point() else value.copy_(state[key])
        smooth = loss.item() if smooth is None else 0.97 * smooth + 0.03 * loss.item()
        if step % 25 == 0:
            line = {"step": step, "loss": round(smooth, 4), "views": len(pool), "cpu": round(time.process_time())}
            print(json.dumps(line), flush=True)
        if time.monotonic() - saved > 120:
            save_classifier(average, folder)
            state = {"network": network.state_dict(), "average": average.state_dict(), "step": step}
            state |= {"optimiser": optimiser.state_dict(), "seconds": spent + time.monotonic() - started}
            torch.save(state, folder / "checkpoint.tmp")
            os.replace(folder / "checkpoint.tmp", checkpoint)
            saved = time.monotonic()
    save_classifier(average, folder)
    checkpoint.unlink(missing_ok=True)
    shutil.rmtree(folder / "views", ignore_errors=True)


def measure(folder: Path, rounds: int, catalogue: Catalogue = COARSE) -> dict:
    """Accuracy on `rounds` unseen random bodies of each kind, per class, a view alone and the four views' mean."""
    classifier = load_classifier(folder)
    names = list(catalogue.body_weights)
    views = joined([make_views(body, UNSEEN_SEED + turn, catalogue) for turn in range(rounds) for body in names])
    pair = (views.before / np.float32(127), views.after / np.float32(127))
    right = classifier(*pair).argmax(1) == views.label
    per_part = {}
    for label, name in enumerate(classifier.classes):
        of_part = (views.label == label) & ~views.blob
        groups = {"overview": of_part & ~views.closeup, "closeup": of_part & views.closeup}
        per_part[name] = {key: round(float(right[where].mean()), 3) for key, where in groups.items() if where.any()}
        per_part[name]["views"] = int(of_part.sum())
    return {
        "views": len(views),
        "accuracy": round(float(right.mean()), 4),
        "blobs_refused": round(float(right[views.blob].mean()), 4),
        "per_part": per_part,
        "per_body": {name: round(float(right[views.body == i].mean()), 3) for i, name in enumerate(names)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: this folder, or `fine` in it")
    parser.add_argument("--words", choices=CATALOGUES, default="coarse", help="which prior's; default: coarse")
    parser.add_argument("--bodies", type=int, default=500, help="random bodies, all parts each; default: 500")
    parser.add_argument("--steps", type=int, default=1600, help="of 96 views; default: 1600")
    parser.add_argument("--seconds", type=float, default=1e9, help="end, with a finished schedule, after this time")
    parser.add_argument("--rounds", type=int, default=4, help="unseen bodies of each kind to measure on; default: 4")
    parser.add_argument("--measure", action="store_true", help="do not train")
    options = parser.parse_args()
    torch.set_num_threads(1)
    catalogue = CATALOGUES[options.words]
    output = options.output or (FOLDER if catalogue is COARSE else FOLDER / options.words)
    if not options.measure:
        train(output, options.bodies, options.steps, options.seconds, catalogue)
    figures = measure(output, options.rounds, catalogue)
    (output / "accuracy.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
