"""Makes math/marinestd.{json,safetensors}: the parts of MarineSTD-GS that 3D-USE trains.

Written from the equations in docs/science/methods.md alone, in NumPy. Gradients are by complex steps, and the
same formulas run in complex64 give f32_max_abs_err, as in rivals.py. Usage: python marinestd.py FOLDER
"""

import sys

import numpy as np

from part import Part, absolute, gradient

C0 = 0.282094791773878


def edge_weight(light, prior, axis):
    """exp(-|difference|) of the photograph, mixed with that of the prior where there is one."""
    first = [slice(None)] * 2
    first[axis] = slice(None, -1)
    of_light = np.exp(-np.abs(np.diff(light, axis=axis)))
    if prior is None:
        return of_light
    q = prior / prior.max()
    return q[tuple(first)] * np.exp(-np.abs(np.diff(q, axis=axis))) + (1 - q[tuple(first)]) * of_light


def smoothness(depth, target, prior, adaptive):
    light = target.sum(axis=2) / target.dtype.type(3)
    known = depth.real > 0
    total = 0
    for axis in (0, 1):
        both = np.logical_and(np.take(known, range(1, known.shape[axis]), axis), np.take(known, range(known.shape[axis] - 1), axis))
        steps = np.where(both, absolute(np.diff(depth, axis=axis)), 0)
        total = total + (steps * edge_weight(light, prior if adaptive else None, axis)).mean()
    return {"smoothness": total}


def relu(z):
    return np.where(z.real > 0, z, 0)


def caustics(values, means, constants, sides, view):
    """Light of a view that is added to the constant coefficients, and the mean of its square."""
    hidden, inputs, code = 64, 9, 16
    real = means.dtype.type
    m = np.abs(means).max(axis=1, keepdims=True)
    place = (np.where(m > 1, (2 - 1 / m) * means / m, means) + 2) / 4
    at, features = 0, []
    for side in sides:
        grid = values[at : at + 2 * side**3].reshape(side, side, side, 2)  # z, y, x, feature
        at += 2 * side**3
        p = place * real(side - 1)
        low = np.minimum(p.astype(int), side - 2)
        part = p - low
        feature = 0
        for dz in (0, 1):
            for dy in (0, 1):
                for dx in (0, 1):
                    w = np.ones(len(means), real)
                    for axis, d in enumerate((dx, dy, dz)):
                        w = w * (part[:, axis] if d else 1 - part[:, axis])
                    feature = feature + w[:, None] * grid[low[:, 2] + dz, low[:, 1] + dy, low[:, 0] + dx]
        features.append(feature)
    x = np.concatenate(features + [(real(C0) * constants + real(0.5)).astype(values.dtype)], axis=1)
    w1 = values[at : at + hidden * inputs].reshape(hidden, inputs)
    at += hidden * inputs
    w1z = values[at : at + hidden * code].reshape(hidden, code)
    at += hidden * code
    bias = values[at : at + hidden]
    at += hidden
    w2 = values[at : at + 3 * hidden].reshape(3, hidden)
    at += 3 * hidden
    z = values[at:].reshape(-1, code)[view]
    light = relu(relu(x @ w1.T + (w1z @ z + bias)) @ w2.T)
    return {"shown": constants + light / real(C0), "squares": (light * light).mean()}


def per_view(numbers, centers, axes, center, axis):
    """Colour, attenuation and backscatter of the training view nearest by centre, and then by axis."""
    far = ((centers - center) ** 2).sum(axis=1)
    near = np.flatnonzero(far == far.min())
    p, q, r = numbers[near[np.argmax(axes[near] @ axis)]]
    ten = numbers.real.dtype.type(10)
    return {"maps": np.stack([1 / (1 + np.exp(-p)), np.log(1 + np.exp(q)) / ten, np.log(1 + np.exp(r)) / ten])}


def main(folder):
    rng = np.random.default_rng(622)
    part = Part("marinestd", "Parts of MarineSTD-GS")

    def case(name, function, moving, inputs, config, note):
        part.case(name, function, moving, inputs, config, note, lambda shape: np.float32(rng.uniform(0.5, 1.5, shape)))

    h, w = 21, 26
    depth = (3 + np.cos(np.arange(h)[:, None] / 5) + np.sin(np.arange(w)[None] / 4)).astype(np.float32)
    depth += (0.2 * rng.standard_normal((h, w))).astype(np.float32)
    depth = np.maximum(depth, 0.05).astype(np.float32)
    target = np.clip(0.5 + 0.3 * rng.standard_normal((h, w, 3)), 0, 1).astype(np.float32)
    prior = np.clip(1.8 - 0.3 * depth + 0.2 * rng.standard_normal((h, w)), 0.01, 2).astype(np.float32)
    depth[3:6, 4:9] = 0
    prior[12:15, 10:20] = 0
    for name, adaptive in [("smoothness", False), ("adaptive_smoothness", True)]:
        case(
            name,
            lambda depth, target, prior, adaptive=adaptive: smoothness(depth, target, prior, adaptive),
            ["depth"],
            {"depth": depth, "target": target, "prior": prior},
            {"height": h, "width": w},
            "empty pixels and unknown priors; edges of the " + ("prior and the photograph" if adaptive else "photograph"),
        )

    sides, n, views = [2, 3, 4], 40, 3
    count = sum(2 * s**3 for s in sides) + 64 * 25 + 64 + 3 * 64 + views * 16
    values = (0.25 * rng.standard_normal(count)).astype(np.float32)
    values[: sum(2 * s**3 for s in sides)] *= np.float32(4)
    values[-views * 16 :] *= np.float32(0.25)
    means = rng.standard_normal((n, 3)).astype(np.float32)
    means[:4] *= np.float32(5)
    constants = (0.8 * rng.standard_normal((n, 3))).astype(np.float32)
    outer = slice(count - views * 16 - 192, count - views * 16)
    lit = np.zeros(3)
    while lit.min() < 0.3 or lit.max() > 0.8:  # Gaussians on both sides of the kink, in every channel
        values[outer] = (0.25 * rng.standard_normal(192)).astype(np.float32)
        lit = (caustics(values.astype(float), means, constants, sides, 1)["shown"] > constants).mean(axis=0)
    case(
        "caustics",
        lambda values, means, constants: caustics(values, means, constants, sides, 1),
        ["values"],
        {"values": values, "means": means, "constants": constants},
        {"views": views, "view": 1, "sides": sides},
        "grids of 2, 3 and 4 nodes a side; centres inside and outside of the cube",
    )
    centers = rng.standard_normal((5, 3)).astype(np.float32)
    centers[3] = centers[1]
    axes = np.tile(np.float32([0, 0, 1]), (5, 1))
    axes[1], axes[3] = [0.6, 0, 0.8], [0, -0.8, 0.6]
    case(
        "per_view",
        per_view,
        ["numbers"],
        {
            "numbers": rng.standard_normal((5, 3, 3)).astype(np.float32),
            "centers": centers,
            "axes": axes,
            "center": (centers[1] + np.float32([0.125, -0.0625, 0])).astype(np.float32),
            "axis": np.float32([0, -1, 0]),
        },
        {},
        "two views with one centre, of which the axis chooses one",
    )
    part.write(folder)


if __name__ == "__main__":
    main(sys.argv[1])
