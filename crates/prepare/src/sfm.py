"""One step of finding cameras with pycolmap: check, features, matches, pairs, verify or map.

The arguments are the step and the path of a file with a JSON object.

Names of arguments and options changed between versions of pycolmap, so each is looked up before it is used.
"""

import sys

# Python would import modules from the folder in which it is started, and so run files of the user.
sys.path = [place for place in sys.path if place]

import json
import os

import pycolmap

# Progress is read from the log lines that pycolmap writes to stderr.
if hasattr(pycolmap, "logging"):
    pycolmap.logging.logtostderr = True
    pycolmap.logging.minloglevel = 0


# The options of the mapper that keep a known lens.
FIXED = {"ba_refine_focal_length": False, "ba_refine_extra_params": False}


def set_options(options, values):
    """Sets the options that this version has; names have dots for options in options."""
    for name, value in values.items():
        *path, last = name.split(".")
        place = options
        for part in path:
            place = getattr(place, part, None)
        if place is not None and hasattr(place, last):
            setattr(place, last, value)
    return options


def call(function, *positional, **named):
    """Calls a function with those named arguments that its signature has."""
    text = function.__doc__ or ""
    return function(*positional, **{name: value for name, value in named.items() if name + ":" in text})


def first_class(*names):
    return next(getattr(pycolmap, name)() for name in names if hasattr(pycolmap, name))


def check(_job):
    """Fails if this version cannot keep a known lens. It runs before any other step."""
    options = pycolmap.IncrementalPipelineOptions()
    missing = [name for name in FIXED if not hasattr(options, name)]
    if missing:
        sys.exit("this version of pycolmap has no option " + " or ".join(missing))


def features(job):
    reader = set_options(
        pycolmap.ImageReaderOptions(),
        {
            "camera_model": job["lens"],
            "camera_params": ",".join(map(repr, job["calibration"])),
            "default_focal_length_factor": job["focal"],
            "mask_path": job["masks"],
        },
    )
    sift = {"max_num_features": job["features"], "max_image_size": job["side"], "num_threads": job["threads"],
            "use_gpu": job["card"]}
    both = {**sift, **{"sift." + name: value for name, value in sift.items()}}
    options = set_options(first_class("FeatureExtractionOptions", "SiftExtractionOptions"), both)
    for group in job["groups"]:
        call(
            pycolmap.extract_features,
            job["database"],
            job["images"],
            image_names=group,
            image_list=group,
            camera_mode=pycolmap.CameraMode.SINGLE,
            camera_model=job["lens"],
            reader_options=reader,
            extraction_options=options,
            sift_options=options,
            device=pycolmap.Device.auto if job["card"] else pycolmap.Device.cpu,
        )


def matching_options(job):
    threads = {"num_threads": job["threads"], "use_gpu": job["card"]}
    both = {**threads, **{"sift." + name: value for name, value in threads.items()}}
    return set_options(first_class("FeatureMatchingOptions", "SiftMatchingOptions"), both)


def verification_options():
    return set_options(first_class("TwoViewGeometryOptions"), {"ransac.random_seed": 0})


def matches(job):
    options, verification = matching_options(job), verification_options()
    if job["matching"] == "exhaustive":
        function, pairing = pycolmap.match_exhaustive, first_class("ExhaustivePairingOptions", "ExhaustiveMatchingOptions")
        pairing = set_options(pairing, {"block_size": job["block"]})
    else:
        function, pairing = pycolmap.match_sequential, first_class("SequentialPairingOptions", "SequentialMatchingOptions")
        pairing = set_options(pairing, {"overlap": job["overlap"], "quadratic_overlap": True, "loop_detection": False})
    # Older versions call the options of the pairs `matching_options` and those of SIFT `sift_options`.
    newer = "pairing_options:" in (function.__doc__ or "")
    named = {"matching_options": options, "pairing_options": pairing} if newer else {
        "sift_options": options, "matching_options": pairing}
    call(
        function,
        job["database"],
        verification_options=verification,
        device=pycolmap.Device.auto if job["card"] else pycolmap.Device.cpu,
        **named,
    )


def pairs(job):
    """Compares the pairs of a list."""
    if not hasattr(pycolmap, "match_image_pairs"):
        print("this version of pycolmap compares no listed pairs, so images far apart stay apart")
        return
    call(
        pycolmap.match_image_pairs,
        job["database"],
        matching_options=matching_options(job),
        pairing_options=set_options(pycolmap.ImportedPairingOptions(), {"match_list_path": job["list"]}),
        verification_options=verification_options(),
        device=pycolmap.Device.auto if job["card"] else pycolmap.Device.cpu,
    )


def verify(job):
    """Checks matches that another program wrote into the database: those of one rigid scene stay."""
    if not hasattr(pycolmap, "geometric_verification"):
        pycolmap.verify_matches(job["database"], job["list"], verification_options())
        return
    threads = set_options(pycolmap.GeometricVerifierOptions(), {"num_threads": job["threads"]})
    call(
        pycolmap.geometric_verification,
        job["database"],
        verifier_options=threads,
        two_view_geometry_options=verification_options(),
    )


def map_images(job):
    os.makedirs(job["models"], exist_ok=True)
    seed = {"random_seed": 0, "mapper.random_seed": 0, "triangulation.random_seed": 0}
    threads = {"num_threads": job["threads"], "mapper.num_threads": job["threads"]}
    small = {"min_model_size": job["smallest"], "mapper.init_min_tri_angle": job["first_angle"]}
    if job["fixed"]:
        check(job)
    fixed = FIXED if job["fixed"] else {}
    if job["held"]:
        fixed = {"ba_refine_focal_length": False, "mapper.abs_pose_refine_focal_length": False}
    if job["mapper"] == "global":
        if job["fixed"]:
            sys.exit("the global mapper does not keep a known lens; take the incremental one")
        if not hasattr(pycolmap, "global_mapping"):
            sys.exit("this version of pycolmap has no global mapper; take the incremental one")
        options = set_options(pycolmap.GlobalPipelineOptions(), {**seed, **threads})
        pycolmap.global_mapping(job["database"], job["images"], job["models"], options)
        return
    options = set_options(pycolmap.IncrementalPipelineOptions(), {**seed, **threads, **small, **fixed})
    pycolmap.incremental_mapping(job["database"], job["images"], job["models"], options)


if hasattr(pycolmap, "set_random_seed"):
    pycolmap.set_random_seed(0)
with open(sys.argv[2], encoding="utf-8") as file:
    given = json.load(file)
steps = {"check": check, "features": features, "matches": matches, "pairs": pairs, "verify": verify}
{**steps, "map": map_images}[sys.argv[1]](given)
