"""Makes math/rivals.{json,safetensors}: terms of the methods that 3D-USE is compared with.

Written from the published equations alone, in NumPy. Gradients are by complex steps: f(x + ih) has the
imaginary part h f'(x) to the last digit. The same formulas run in complex64 give f32_max_abs_err.
Usage: python rivals.py FOLDER
"""

import sys

import numpy as np

from part import Part, absolute, gradient

EPS = 1e-3


def conv(x, taps):
    """Separable convolution of [H, W, C], valid region."""
    n = len(taps)
    rows = sum(t * x[i : x.shape[0] - n + 1 + i] for i, t in enumerate(taps))
    return sum(t * rows[:, i : rows.shape[1] - n + 1 + i] for i, t in enumerate(taps))


def window(dtype):
    x = np.arange(11) - 5.0
    g = np.exp(-(x**2) / (2 * 1.5**2))
    return (g / g.sum()).astype(dtype)


def ssim(a, b):
    """Mean over channels of the mean SSIM, as one level of MS-SSIM."""
    taps = window(a.real.dtype)
    c1, c2 = a.real.dtype.type(1e-4), a.real.dtype.type(9e-4)
    ma, mb = conv(a, taps), conv(b, taps)
    va, vb, vab = conv(a * a, taps) - ma * ma, conv(b * b, taps) - mb * mb, conv(a * b, taps) - ma * mb
    s = (2 * ma * mb + c1) / (ma * ma + mb * mb + c1) * (2 * vab + c2) / (va + vb + c2)
    return s.mean()


def photometric(pred, target, lam, relative):
    w = 1 / (pred.real + EPS) if relative else np.ones_like(pred.real)
    w = w.astype(pred.real.dtype)
    l1 = absolute(w * (pred - target)).mean()
    structure = 1 - ssim(w * pred, w * target)
    return {"l1": l1, "ssim": structure, "total": (1 - lam) * l1 + lam * structure}


def patches(x, known):
    """Means over 16 x 16 overlapping patches, of the pixels that are known; NaN where there is none."""
    out = []
    h, w = known.shape
    for i in range(16):
        for j in range(16):
            r = slice(i * h // 16, -(-(i + 1) * h // 16))
            c = slice(j * w // 16, -(-(j + 1) * w // 16))
            k = known[r, c]
            if k.any():
                out.append(x[r, c][k].sum() / k.sum().astype(x.real.dtype))
    return np.array(out)


def ranking(depth, prior):
    known = (depth.real > 0) & (prior > 0)
    p = patches(depth / depth.real[known].max(), known)
    q = patches(prior / prior[known].max(), known)
    product = (p[:, None] - p[None]) * (q[:, None] - q[None])
    return {"depth_ranking": np.where(product.real > 0, product, 0).mean()}


def main(folder):
    rng = np.random.default_rng(62)
    part = Part("rivals", "Terms of the compared methods")

    def case(name, function, moving, inputs, config, outputs, note):
        part.cases[name] = {
            "config": config | {"height": inputs[moving].shape[0], "width": inputs[moving].shape[1]},
            "grads": [moving],
            "note": note,
            "pulls": {o: [o] for o in outputs},
        }
        for key, value in inputs.items():
            part.put(f"{name}/in.{key}", value)

        def run(real, x):
            given = {k: v.astype(real) for k, v in inputs.items()} | {moving: x}
            return function(**given)

        exact = run(np.float64, inputs[moving].astype(np.complex128))
        single = run(np.float32, inputs[moving].astype(np.complex64))
        for o in outputs:
            part.put(f"{name}/out.{o}", exact[o].real, abs(exact[o].real - single[o].real))
            cotangent = np.float32(rng.uniform(0.5, 1.5))
            part.put(f"{name}/cot.{o}", cotangent)
            x = inputs[moving]
            g = float(cotangent) * gradient(lambda z: run(np.float64, z)[o], x.astype(np.float64), np.complex128)
            s = cotangent * gradient(lambda z: run(np.float32, z)[o], x.astype(np.float32), np.complex64)
            part.put(f"{name}/grad.{o}.{moving}", g, np.abs(g - s).max())

    h, w = 19, 23
    base = 0.5 + 0.3 * np.sin(np.arange(h)[:, None, None] / 3 + np.arange(w)[None, :, None] / 4 + np.arange(3))
    pred = np.clip(base + 0.08 * rng.standard_normal((h, w, 3)), 0.02, 1.2).astype(np.float32)
    target = np.clip(base + 0.08 * rng.standard_normal((h, w, 3)), 0, 1).astype(np.float32)
    for name, relative in [("ssim", False), ("reg_ssim", True)]:
        case(
            name,
            lambda pred, target, relative=relative: photometric(pred, target, 0.2, relative),
            "pred",
            {"pred": pred, "target": target},
            {"lam": 0.2},
            ["l1", "ssim", "total"],
            "absolute error and one level of SSIM" + (", relative to the prediction" if relative else ""),
        )
    h, w = 37, 45
    depth = (1.5 + np.cos(np.arange(h)[:, None] / 9) + np.sin(np.arange(w)[None] / 7)).astype(np.float32)
    depth += (0.2 * rng.standard_normal((h, w))).astype(np.float32)
    depth = np.maximum(depth, 0).astype(np.float32)
    prior = np.clip(1.2 - 0.3 * depth + 0.3 * rng.standard_normal((h, w)), 0.01, 2).astype(np.float32)
    depth[3:6, 4:9] = 0
    prior[20:26, 30:40] = 0
    case(
        "ranking",
        lambda depth, prior: ranking(depth, prior),
        "depth",
        {"depth": depth, "prior": prior},
        {},
        ["depth_ranking"],
        "16 x 16 overlapping patches; unknown depths and priors, some patches without a known pixel",
    )
    part.write(folder)


if __name__ == "__main__":
    main(sys.argv[1])
