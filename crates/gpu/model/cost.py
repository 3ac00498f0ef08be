#!/usr/bin/env python3
"""Estimates the time of a step of each stage on a graphics card, kernel by kernel, without a card.

    python3 crates/gpu/model/cost.py [--card h100|h200|4090] [--gaussians N] [--entries N]
    python3 crates/gpu/model/cost.py --measured card.json

A kernel takes the longest of three times: its instructions at the rate at which the card issues them, its
exchanges between threads at their rate, and its bytes at the rate of the memory. Two columns are printed: the
kernels as they were when the model was made (`before`), and as they are (`now`). With a file of `use3d bench
gpu` the model is computed for the counts of its largest training, beside the card's own times.

The counts were measured on a trained reef (153,815 Gaussians, four views of 1400 x 788) and scaled to the load
below. An instruction of a warp of 32 threads is a slot. The slots of a loop were counted in the kernels' texts.
"""

import argparse
import json
import pathlib
from dataclasses import dataclass

# Multiprocessors, clock in Hz, bytes per second of the memory.
CARDS = {"h100": (132, 1.98e9, 2.7e12), "h200": (132, 1.98e9, 4.0e12), "4090": (128, 2.5e9, 0.95e12)}
# Warp instructions that a multiprocessor issues per clock, and the share of them that such kernels reach.
ISSUE = 4
REACHED = 0.6
# Seconds of a launch with its barrier.
LAUNCH = 3.5e-6


@dataclass
class Load:
    """One view of a trained scene."""

    width: int = 1400
    height: int = 933
    gaussians: int = 500_000
    entries: int = 1_200_000
    # Pairs of pixel and Gaussian, per pixel: tested, and those that contribute.
    tested: float = 155.0
    live: float = 50.0
    # The share of the Gaussians of a tile that concern a warp of the forward pass.
    concern: float = 0.57

    @property
    def pixels(self):
        return self.width * self.height

    @property
    def hits(self):
        """Pairs of a subgroup's rectangle and a Gaussian in it, per pixel."""
        return 0.029 * self.live


class Card:
    def __init__(self, name):
        cores, clock, self.bytes = CARDS[name]
        self.slots = ISSUE * cores * clock * REACHED
        self.exchanges = cores * clock

    def time(self, slots=0.0, exchanges=0.0, moved=0.0, launches=1):
        longest = max(slots / self.slots, exchanges / self.exchanges, moved / self.bytes)
        return 1e3 * (longest + launches * LAUNCH)


def kernels(card, load, now):
    """Yields the name and the milliseconds of every group of kernels."""
    p, n, e = load.pixels, load.gaussians, load.entries
    warps = p / 32
    # A counter of 64 bits in every loop and a comparison per index, in the program before.
    check = 0 if now else 7
    yield "unpack, mix, look", card.time(moved=130 * p * 1.9, launches=3)
    # Rows of 192 bytes are read one number at a time, so each load touches 32 lines.
    yield "project", card.time(moved=(104 + 192 * 0.7) * n * 3.2)
    yield "sort by depth", card.time(moved=4 * 20 * n, launches=12) + 0.045
    yield "lists, sort by tile", card.time(moved=(8 * n + 60 * e) * 4, launches=11) + 0.08
    yield "forward", card.time(slots=warps * load.tested * (15 + check + load.concern * 58))
    # Both ways on three levels of three channels; the taps were read from a uniform by their index.
    structure = 3 * warps * (1 + 1 / 4 + 1 / 16)
    yield "losses", card.time(slots=2 * structure * (600 if now else 1000), launches=17) + 0.1
    reduction = 70 if now else 120
    exchanged = 16 if now else 60
    hits = load.hits * p
    slots = hits * (173 + check + 45 + reduction)
    yield "backward (subgroups of 32)", card.time(slots=slots, exchanges=hits * exchanged)
    if now:
        yield "sums of long runs", card.time(moved=12 * e) + 0.02
        yield "update", card.time(moved=384 * n + 48 * e)
        yield "update of colours", card.time(moved=1176 * n)
    else:
        # 288 loads and stores of numbers 192 bytes apart: each warp's touches 32 lines, four per clock.
        yield "update", 1e3 * 288 * n / (card.exchanges * 1.0)
        # A Gaussian with 3,000 entries was added up by one thread, load after load.
        yield "its longest run", 0.3
    # Two loads of workgroup memory for a product; rows of 128 numbers collide in the banks.
    products = 144 * p / 32
    conflicts = 1 if now else 7
    yield "gather of the water", card.time(slots=products * 0.35, exchanges=2 * products * conflicts)
    yield "other small kernels", card.time(launches=20) + 0.1


def stage2(card, gaussians, now):
    """Yields the name and the milliseconds of the parts of a step of stage 2.

    On its lattice of 96 x 54 pixels the longest tile has 4,043 entries at 153,815 Gaussians. A view has 160,000
    pairs of pixel and Gaussian.
    """
    longest = 4043 * gaussians / 153_815
    pairs = 160_000
    if now:
        yield "sums by pixel", card.time(moved=pairs * 40) + 0.01
        yield "sums by entry", card.time(moved=pairs * 40) + 0.01
    else:
        # 319 steps with a barrier for every 64 entries, on few multiprocessors.
        yield "forward", 0.3 * gaussians / 400_000 + 0.1
        yield "colours backward", 1e3 * longest / 64 * 319 * 60e-9
    yield "field, water, sums", card.time(launches=16) + 0.15
    yield "extractor and losses, on the processor", 1.0
    yield "recording, waits", 0.5


# The parts of the model, and the kernels in a file of `use3d bench gpu`.
MEASURED = {
    "unpack, mix, look": ["unpack", "mix", "look"],
    "project": ["project"],
    "sorts and lists": [
        "sort: histogram", "sort: spread", "sort: scatter", "reduce", "offsets", "emit", "starts",
    ],
    "forward": ["forward"],
    "losses": [
        "weigh", "pool", "compare", "weigh_levels", "blur_back", "pull", "tell", "gains", "depth_means",
        "depth_take_means", "depth_deviations", "depth_correlate", "depth_slopes",
    ],
    "backward (subgroups of 32)": ["backward"],
    "sums of long runs": ["sums of long runs"],
    "update": ["update"],
    "update of colours": ["update of colours"],
    "gather of the water": ["gather"],
}


def largest(path):
    """The training of a file with the most work: its load and the milliseconds of each part."""
    record = json.loads(pathlib.Path(path).read_text())
    done = [t for t in record["trainings"] if t.get("steps_per_second")]
    training = max(done, key=lambda t: t["size"][0] * t["size"][1] * t["gaussians"])
    view, (width, height) = training["view"], training["size"]
    load = Load(
        width, height, training["gaussians"], view["entries"], view["tested_per_pixel"], view["live_per_pixel"]
    )
    steps = training["kernels"]["finish"]["dispatches"]
    times = {n: k["milliseconds"] * k["dispatches"] / steps for n, k in training["kernels"].items()}
    parts = {part: sum(times.pop(name, 0.0) for name in names) for part, names in MEASURED.items()}
    parts["other small kernels"] = sum(times.values())
    return record["adapter"]["name"], load, parts, 1e3 / training["steps_per_second"]


def joined(times):
    """The model's two parts that the card's clock does not tell apart are one."""
    out = {"sorts and lists": 0.0}
    for name, time in times.items():
        key = "sorts and lists" if name in ("sort by depth", "lists, sort by tile") else name
        out[key] = out.get(key, 0.0) + time
    return out


def compare(card, path):
    name, load, measured, step = largest(path)
    model = joined(dict(kernels(card, load, True)))
    print(f"{name}, {load.width} x {load.height}, {load.gaussians} Gaussians, {load.entries} entries")
    print(f"\n{'milliseconds':<40} {'model':>8} {'card':>8}")
    for part in sorted(measured, key=lambda part: -measured[part]):
        print(f"{part:<40} {model.get(part, 0.0):>8.2f} {measured[part]:>8.2f}")
    print(f"{'all kernels':<40} {sum(model.values()):>8.2f} {sum(measured.values()):>8.2f}")
    print(f"{'a step':<40} {'':>8} {step:>8.2f}")


def table(before, now, title):
    print(f"\n{'milliseconds':<40} {'before':>8} {'now':>8}")
    for name in list(before) + [name for name in now if name not in before]:
        cells = [f"{times[name]:.2f}" if name in times else "-" for times in (before, now)]
        print(f"{name:<40} {cells[0]:>8} {cells[1]:>8}")
    print(f"{title:<40} {sum(before.values()):>8.2f} {sum(now.values()):>8.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--card", choices=sorted(CARDS), default="h100")
    parser.add_argument("--gaussians", type=int, default=Load.gaussians)
    parser.add_argument("--entries", type=int, default=Load.entries)
    parser.add_argument("--measured", metavar="FILE", help="compare with a file of `use3d bench gpu`")
    args = parser.parse_args()
    if args.measured:
        return compare(Card(args.card), args.measured)
    card, load = Card(args.card), Load(gaussians=args.gaussians, entries=args.entries)
    before, now = (dict(kernels(card, load, now)) for now in (False, True))
    print(f"{args.card}, {load.width} x {load.height}, {load.gaussians} Gaussians, {load.entries} entries")
    table(before, now, "a step of stage 1")
    table(*(dict(stage2(card, args.gaussians, now)) for now in (False, True)), "a step of stage 2")


if __name__ == "__main__":
    main()
