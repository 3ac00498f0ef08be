"""Makes math/uir.{json,safetensors}: the water, formation and terms of 3D-UIR.

Written from the equations of docs/science/methods.md alone, in NumPy, like rivals.py beside it.
Usage: python uir.py FOLDER
"""

import sys

import numpy as np
from part import Part, absolute, gradient

UNITS, CODE, POSE = 32, 16, 12


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def softplus(x):
    return np.log(1 + np.exp(x))


def inverse(depth, opacity):
    """Inverse depth of a pixel with this opacity and expected depth; 0 where nothing is hit."""
    return np.where(depth.real > 1e-6, opacity / np.where(depth.real > 1e-6, depth, 1), 0)


def formation(light, depth, opacity, color, network):
    """Image of [H, W, 3] light under the water that `network` describes."""
    one = network.real.dtype.type
    veil, residual, rate = network[0:3], network[3:6], network[6:9]
    w, b = network[9 : 9 + UNITS], network[9 + UNITS : 9 + 2 * UNITS]
    v = network[9 + 2 * UNITS : 9 + 5 * UNITS].reshape(UNITS, 3)
    offsets = network[9 + 5 * UNITS :]
    q = inverse(depth, opacity)
    a = sigmoid(sigmoid(sigmoid(q[..., None] * w + b) @ v + offsets))
    z = 1 / (q + one(1e-5))[..., None]
    # An exponential that is zero in single precision is zero.
    fade = lambda k: np.where((k * z).real < 80, np.exp(-np.where((k * z).real < 80, k * z, 0)), 0)
    return {"image": light * a + color * (1 - fade(veil)) + residual * fade(rate)}


def water(constants, code_weight, code_bias, depth_weight, hidden_weight, hidden_bias, output_weight,
          output_bias, center, rotation):
    """Colour and numbers of the network of a view, in the order of `DepthNetwork::values`."""
    pose = np.concatenate([center, rotation.ravel()])
    code = code_weight @ pose + code_bias
    biases = hidden_weight @ code + hidden_bias
    numbers = [softplus(constants[1]), sigmoid(constants[2]), softplus(constants[3])]
    numbers += [depth_weight, biases, output_weight.T.ravel(), output_bias]
    return {"color": sigmoid(constants[0]), "network": np.concatenate(numbers)}


def appearance(values, constants):
    """Coefficients as view 1 of 3 shows them; and, without a gradient here, as the mean of all views."""
    inner, code, bias, outer, last, codes = np.split(values, np.cumsum([96, 512, 32, 192, 6]))
    c0 = constants.real.dtype.type(0.28209479177387814)
    c = c0 * constants + constants.real.dtype.type(0.5)

    def shown(z):
        hidden = sigmoid(c @ inner.reshape(32, 3).T + code.reshape(32, CODE) @ z + bias)
        out = hidden @ outer.reshape(6, 32).T + last
        return constants + (c * out[:, :3] + out[:, 3:]) / c0

    codes = codes.reshape(3, CODE)
    return {"shown": shown(codes[1]), "mean": shown(codes.mean(0))}


def spread(x):
    middle = np.sort(x.real)[len(x) // 2]
    return middle, np.abs(x.real - middle).mean()


def agreement(depth, opacity, prior):
    known = (depth.real > 0) & (prior > 0)
    q, p = inverse(depth, opacity)[known], prior[known]
    (mq, sq), (mp, sp) = spread(q), spread(p)
    return {"inverse_depth": absolute(q - ((p - mp) * (sq / sp) + mq)).mean()}


def variation(depth, opacity):
    q = inverse(depth, opacity)
    return {"depth_variation": absolute(q[:, 1:] - q[:, :-1]).mean() + absolute(q[1:] - q[:-1]).mean()}


def flatness(scales):
    smallest = np.take_along_axis(np.exp(scales), scales.real.argmin(1)[:, None], 1)
    return {"flatness": smallest.mean()}


def main(folder):
    rng = np.random.default_rng(63)
    part = Part("uir", "Water, formation, terms of 3D-UIR")

    def case(name, function, moving, inputs, note, config=None, pull="all", pulled=None):
        exact = function(**{k: v.astype(np.float64) for k, v in inputs.items()})
        outputs, pulls = list(exact), pulled or list(exact)
        shape = next(iter(inputs.values())).shape
        part.cases[name] = {
            "config": config or {"height": shape[0], "width": shape[1]},
            "grads": moving,
            "note": note,
            "pulls": {pull: pulls},
        }
        single = function(**{k: v.astype(np.float32) for k, v in inputs.items()})
        cotangents = {o: np.float32(rng.uniform(0.5, 1.5, np.shape(exact[o]))) for o in outputs}
        for key, value in inputs.items():
            part.put(f"{name}/in.{key}", value)
        for o in outputs:
            part.put(f"{name}/out.{o}", exact[o], np.abs(exact[o] - single[o]).max())
            part.put(f"{name}/cot.{o}", cotangents[o])

        def total(real, key, x):
            found = function(**{k: v.astype(real) for k, v in inputs.items()} | {key: x})
            return sum((cotangents[o].astype(real) * found[o]).sum() for o in pulls)

        for key in moving:
            x = inputs[key]
            g = gradient(lambda v: total(np.float64, key, v), x.astype(np.float64), np.complex128)
            s = gradient(lambda v: total(np.float32, key, v), x.astype(np.float32), np.complex64)
            part.put(f"{name}/grad.{pull}.{key}", g, np.abs(g - s).max())

    f = np.float32
    h, w = 19, 23
    wave = np.sin(np.arange(h)[:, None, None] / 3 + np.arange(w)[None, :, None] / 4 + np.arange(3))
    depth = f(1.4 + np.cos(np.arange(h)[:, None] / 5) * np.sin(np.arange(w)[None] / 4))
    opacity = f(np.clip(0.9 - 0.2 * rng.random((h, w)), 0, 0.999))
    depth[4:7, 9:13], opacity[4:7, 9:13] = 0, 0
    network = np.concatenate([
        rng.uniform(0.2, 0.8, 9), rng.normal(0, 1, UNITS), rng.normal(0, 0.7, UNITS),
        rng.normal(0, 0.5, 3 * UNITS), rng.normal(0, 0.3, 3),
    ])
    inputs = {
        "light": f(0.5 + 0.3 * wave),
        "depth": depth,
        "opacity": opacity,
        "color": f(np.broadcast_to([0.1, 0.3, 0.5], (h, w, 3))),
        "network": f(network),
    }
    case("formation", formation, ["light", "depth", "opacity", "color", "network"], inputs,
         "some rays hit nothing")
    n = lambda scale, *shape: f(rng.normal(0, scale, shape))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation = f(rotation * np.linalg.det(rotation))
    center = n(0.6, 3)
    case(
        "water", water,
        ["constants", "code_weight", "code_bias", "depth_weight", "hidden_weight", "hidden_bias",
         "output_weight", "output_bias"],
        {
            "constants": n(1.0, 4, 3), "code_weight": n(0.4, CODE, POSE), "code_bias": n(0.2, CODE),
            "depth_weight": n(0.5, UNITS), "hidden_weight": n(0.3, UNITS, CODE), "hidden_bias": n(0.2, UNITS),
            "output_weight": n(0.4, 3, UNITS), "output_bias": n(0.2, 3), "center": center,
            "rotation": rotation,
        },
        "the pose is a centre and the rows of a rotation into the camera", {},
    )
    case(
        "appearance", appearance, ["values", "constants"],
        {"values": n(0.4, 838 + 3 * CODE), "constants": n(0.8, 25, 3)},
        "view 1 of 3", {"view": 1, "views": 3}, "shown", ["shown"],
    )
    near = inverse(depth, opacity)
    prior = f(np.clip(0.2 + 0.5 * near + 0.1 * rng.standard_normal((h, w)), 0.01, 3))
    prior[12:15, 2:6] = 0
    pixels = {"depth": depth, "opacity": opacity, "prior": prior}
    case("agreement", agreement, ["depth", "opacity"], pixels, "unknown depths and priors")
    del pixels["prior"]
    case("variation", variation, ["depth", "opacity"], pixels, "some rays hit nothing")
    case("flatness", flatness, ["scales"], {"scales": n(0.7, 40, 3) - f(3)}, "all Gaussians are in view")
    part.write(folder)


if __name__ == "__main__":
    main(sys.argv[1])
