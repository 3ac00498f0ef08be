"""Can the water be found if a light moves with the camera?

Fits the equation of docs/science/water.md to the tracks of a capture, without and with a light of nine numbers:

    I = L(p) J e^(-b_a s) + B (1 - e^(-b_b s))
    ln L(p) = c . (u, v, u^2, u v, v^2, l, l^2, u l, v l),      l = ln(s / median s)

I: display value, s: distance, (u, v): the point's direction x/z and y/z in the camera's frame. Each channel has its
own b_a, b_b and B, and each point its own J, which has a closed form. The light is common to all channels.

Prints the cost of each fit, b_a per unit of the model, and the relative error of b_a (48 blocks of points count as
independent). The observations are simpler than those of `use3d water`: bilinear samples of blurred photographs.

    pip install numpy scipy pillow
    python3 crates/water/model/light.py [--inverse-square] CAPTURE...

With --inverse-square the coefficient of l is held near -2, and the other three with l near 0 (0.2 each).
"""

import os
import struct
import sys

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import least_squares

MOST_POINTS = 2500
NOISE = 0.03  # of a display value
BLOCKS = 48
STARTS = (0.05, 0.35)  # of the veil


def unpack(file, form):
    return struct.unpack("<" + form, file.read(struct.calcsize("<" + form)))


def read_model(folder):
    """Cameras, images and points of a binary COLMAP model with pinhole cameras."""
    cameras, images, points, tracks = {}, {}, [], []
    with open(os.path.join(folder, "cameras.bin"), "rb") as file:
        for _ in range(unpack(file, "Q")[0]):
            camera, kind, _, _ = unpack(file, "iiQQ")
            if kind not in (0, 1):
                sys.exit(f"{folder}: camera {camera} is no pinhole camera")
            if kind == 0:
                f, cx, cy = unpack(file, "3d")
                cameras[camera] = (f, f, cx, cy)
            else:
                cameras[camera] = unpack(file, "4d")
    with open(os.path.join(folder, "images.bin"), "rb") as file:
        for _ in range(unpack(file, "Q")[0]):
            (image,) = unpack(file, "i")
            w, x, y, z = unpack(file, "4d")
            translation = np.array(unpack(file, "3d"))
            (camera,) = unpack(file, "i")
            name = b""
            while (letter := file.read(1)) != b"\0":
                name += letter
            file.read(24 * unpack(file, "Q")[0])
            rotation = np.array([
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ])
            images[image] = (rotation, translation, camera, name.decode())
    with open(os.path.join(folder, "points3D.bin"), "rb") as file:
        for _ in range(unpack(file, "Q")[0]):
            unpack(file, "Q")
            points.append(unpack(file, "3d"))
            unpack(file, "3Bd")
            (length,) = unpack(file, "Q")
            tracks.append(sorted(set(unpack(file, f"{2 * length}i")[::2])))
    return cameras, images, np.array(points), tracks


def observe(capture):
    """The rows (point, u, v, s, red, green, blue) of all tracks."""
    cameras, images, points, tracks = read_model(os.path.join(capture, "sparse/0"))
    seen = {}
    for point, track in enumerate(tracks):
        for view in track:
            seen.setdefault(view, []).append(point)
    rows = []
    for view, of_view in seen.items():
        rotation, translation, camera, name = images[view]
        fx, fy, cx, cy = cameras[camera]
        picture = np.asarray(Image.open(os.path.join(capture, "images", name)).convert("RGB"), float) / 255
        planes = [gaussian_filter(picture[..., c], 1.6) for c in range(3)]
        at = points[of_view] @ rotation.T + translation
        u, v = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]
        place = [fy * v + cy - 0.5, fx * u + cx - 0.5]
        colors = [map_coordinates(plane, place, order=1, mode="nearest") for plane in planes]
        rows.append(np.column_stack([of_view, u, v, np.linalg.norm(at, axis=1), *colors])[at[:, 2] > 0])
    return np.concatenate(rows)


def points_with_range(rows):
    """The rows of points that three views see at distances that differ by a quarter, and each row's point."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    _, first, count = np.unique(rows[:, 0], return_index=True, return_counts=True)
    pieces = [rows[at : at + n] for at, n in zip(first, count)]
    pieces = [p for p in pieces if len(p) >= 3 and p[:, 3].max() > 1.25 * p[:, 3].min()]
    np.random.default_rng(0).shuffle(pieces)
    pieces = pieces[:MOST_POINTS]
    return np.concatenate(pieces), np.repeat(np.arange(len(pieces)), [len(p) for p in pieces])


def fit(rows, point, with_light, inverse_square):
    """Returns the cost, b_a per unit, and the relative error of b_a."""
    u, v, s, color = rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:7]
    middle, n = np.median(s), point[-1] + 1
    l, s = np.log(s / middle), s / middle
    basis = np.column_stack([u, v, u * u, u * v, v * v, l, l * l, u * l, v * l])
    counts = ((color > 2.5 / 255) & (color < 253 / 255)).all(1)

    def residuals(x):
        attenuation, backscatter, veil = np.exp(x[:9]).reshape(3, 3)
        light = np.exp(np.clip(basis @ x[9:], -6, 6)) if with_light else 1.0
        out = []
        for c in range(3):
            a = light * np.exp(-attenuation[c] * s)
            y = color[:, c] - veil[c] * (1 - np.exp(-backscatter[c] * s))
            radiance = np.bincount(point, counts * a * y, n) / (np.bincount(point, counts * a * a, n) + 1e-9)
            out.append(counts * (y - a * np.maximum(radiance, 0)[point]) / NOISE)
        weight = 0.015 * np.sqrt(n)
        priors = [weight * (x[3:6] - x[:3]) / 0.5, weight * (x[6:9] - np.log(0.35)) / 0.6]
        if with_light and inverse_square:
            priors.append(0.3 * np.sqrt(n) * (x[14:] - [-2, 0, 0, 0]) / 0.2)
        return np.concatenate(out + priors)

    best = None
    for start in STARTS:
        first = np.concatenate([np.full(6, np.log(0.3)), np.full(3, np.log(start)), np.zeros(9 if with_light else 0)])
        found = least_squares(residuals, first, loss="cauchy", max_nfev=25)
        if best is None or found.cost < best.cost:
            best = found
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * 2 * best.cost / len(best.fun)
    error = np.sqrt(np.diag(covariance) * len(best.fun) / (6 * BLOCKS))
    return best.cost, np.exp(best.x[:3]) / middle, error[:3]


arguments = sys.argv[1:]
inverse_square = "--inverse-square" in arguments
for capture in [a for a in arguments if not a.startswith("--")]:
    rows, point = points_with_range(observe(capture))
    for with_light in (False, True):
        cost, attenuation, error = fit(rows, point, with_light, inverse_square)
        values = ", ".join(f"{b:.4f} (± {100 * e:.0f} %)" for b, e in zip(attenuation, error))
        print(f"{capture}: {'with a light' if with_light else 'no light'}: cost {cost:.0f}, attenuation {values}")
