"""Makes math/seasplat.{json,safetensors}: formation, water and priors of SeaSplat.

Written from the published equations alone, in NumPy. Gradients are by complex steps, as in rivals.py.
Usage: python seasplat.py FOLDER
"""

import sys

import numpy as np

from part import Part, absolute, gradient


def normalised(depth, accumulation):
    """Depths between the nearest (0) and the farthest pixel (1) that are hit; 1 where nothing is."""
    hit = accumulation.real > 0
    some = depth[hit]
    near, far = some[some.real.argmin()], some[some.real.argmax()]
    return np.where(hit, (depth - near) / (far - near), 1)


def positive(x):
    return np.where(x.real > 0, x, 0)


def formation(light, depth, accumulation, c_m, beta_bs, beta_attn):
    z = normalised(depth, accumulation)[..., None]
    image = light * np.exp(-beta_attn * z) + c_m * (1 - np.exp(-beta_bs * z))
    return {"image": np.where(image.real < 0, 0, np.where(image.real > 1, 1, image))}


def far_l1(image, target, depth, accumulation):
    z = normalised(depth, accumulation).real[..., None]
    return {"far_l1": (z * absolute(image - target)).mean()}


def backscatter(target, depth, accumulation, c_m, beta_bs):
    z = normalised(depth, accumulation).real[..., None]
    rest = target - c_m * (1 - np.exp(-beta_bs * z))
    below = positive(-rest)
    smooth = np.where(below.real < 0.2, below * below / below.real.dtype.type(0.4), below - below.real.dtype.type(0.1))
    return {"backscatter": positive(rest).mean() + 1000 * smooth.mean()}


def clear_colors(clear):
    most = clear.real.dtype.type(0.7)
    outside = positive(-clear) + positive(clear - most)
    means = clear.mean(axis=(0, 1))
    return {"saturation": (outside * outside).mean(), "grey_world": ((means - 0.5) ** 2).mean()}


def background(image, accumulation, c_m, laid_over):
    seen = image.real if laid_over else (image - c_m * (1 - accumulation[..., None])).real
    near = np.sqrt(((seen - c_m.real) ** 2).sum(axis=2)) < 0.2 * np.sqrt(3)
    return {"background": accumulation[near].mean()}


def smoothness(depth, target, accumulation):
    """Steps of normalised distance between pixels that are hit, less where the photograph has edges."""
    z, light, hit = normalised(depth, accumulation), target.mean(axis=2), accumulation.real > 0
    total = 0
    for axis in (0, 1):
        both = np.diff(hit.astype(int), axis=axis) == 0
        both &= np.take(hit, range(1, hit.shape[axis]), axis)
        steps = np.where(both, absolute(np.diff(z, axis=axis)), 0)
        total = total + (steps * np.exp(-np.abs(np.diff(light, axis=axis)))).mean()
    return {"smoothness": total}


def water(numbers, lit):
    shape = lit.shape
    exponent = np.where(numbers[1:].real > 0, numbers[1:], 0)
    maps = [1 / (1 + np.exp(-numbers[0])), exponent[0], exponent[1]]
    return {n: np.broadcast_to(m, shape) for n, m in zip(["c_m", "beta_bs", "beta_attn"], maps)}


def main(folder):
    rng = np.random.default_rng(624)
    part = Part("seasplat", "SeaSplat's formation, water and priors")

    def case(name, function, moving, inputs, note, config=None):
        h, w = next(v for v in inputs.values() if v.ndim == 3 or v.shape[0] > 3).shape[:2]
        signed = lambda shape: rng.uniform(0.5, 1.5, shape).astype(np.float32) * rng.choice([-1, 1], shape)
        part.case(name, function, moving, inputs, {"height": h, "width": w} | (config or {}), note, signed)

    h, w = 9, 11
    shape = (h, w, 3)
    wave = np.sin(np.arange(h)[:, None, None] / 2 + np.arange(w)[None, :, None] / 3 + np.arange(3))
    f32 = lambda x: x.astype(np.float32)
    depth = f32(2 + np.cos(np.arange(h)[:, None] / 3) + np.sin(np.arange(w)[None] / 4) + 0.2 * rng.random((h, w)))
    accumulation = f32(rng.uniform(0.2, 0.999, (h, w)))
    # Some pixels are not hit.
    depth[2:4, 3:6] = accumulation[2:4, 3:6] = 0
    c_m = f32(rng.uniform(0.1, 0.8, shape))
    beta_bs, beta_attn = f32(rng.uniform(0.2, 1.5, shape)), f32(rng.uniform(0.2, 1.5, shape))
    # Some colours are clamped at either end.
    light = f32(0.6 + 0.9 * wave + 0.1 * rng.random(shape))
    target = f32(np.clip(0.45 + 0.35 * wave + 0.1 * rng.random(shape), 0, 1))
    formed = formation(light.astype(float), depth.astype(float), accumulation, c_m.astype(float), beta_bs, beta_attn)
    counts = {"low": int((formed["image"] == 0).sum()), "high": int((formed["image"] == 1).sum())}
    assert min(counts.values()) > 5, counts
    view = {"depth": depth, "accumulation": accumulation}
    case(
        "formation",
        formation,
        ["light", "depth", "c_m", "beta_bs", "beta_attn"],
        {"light": light} | view | {"c_m": c_m, "beta_bs": beta_bs, "beta_attn": beta_attn},
        "pixels that are not hit, and colours clamped at either end",
        counts,
    )
    image = f32(target + 0.15 * rng.standard_normal(shape))
    case("far_l1", far_l1, ["image"], {"image": image, "target": target} | view, "weighted by normalised distance")
    case(
        "backscatter",
        backscatter,
        ["c_m", "beta_bs"],
        {"target": target} | view | {"c_m": c_m, "beta_bs": beta_bs},
        "both sides of zero, and both parts of the smooth error",
    )
    case("clear_colors", clear_colors, ["clear"], {"clear": light}, "colours below 0 and above 0.7")
    case("smoothness", smoothness, ["depth"], {"target": target} | view, "pixels that are not hit are in no pair")
    near = f32(c_m + 0.3 * rng.standard_normal(shape))
    for name, laid_over in [("background", True), ("background_before", False)]:
        case(
            name,
            lambda image, accumulation, c_m, laid_over=laid_over: background(image, accumulation, c_m, laid_over),
            ["accumulation"],
            {"image": near, "accumulation": accumulation, "c_m": c_m},
            "water over the image" if laid_over else "before there is water: its share is taken away first",
            {"laid_over": laid_over},
        )
    numbers = f32(rng.uniform(0.2, 1.2, (3, 3)))
    numbers[0] -= 0.9
    numbers[1, 2] = -0.3
    case("water", water, ["numbers"], {"numbers": numbers, "lit": light}, "one exponent below zero")
    part.write(folder)


if __name__ == "__main__":
    main(sys.argv[1])
