"""A part of the golden numbers: tensors with their tolerances, cases, and the two files that hold them.

The programs beside this one fill a part each, from equations alone. Gradients are by complex steps:
f(x + ih) has the imaginary part h f'(x) to the last digit.
"""

import json
import struct

import numpy as np


def absolute(z):
    return np.where(z.real < 0, -z, z)


def gradient(f, x, dtype):
    step = 1e-20
    g = np.zeros(x.shape, x.dtype)
    moved = x.astype(dtype)
    for i in range(x.size):
        moved.flat[i] += 1j * step
        g.flat[i] = f(moved).imag / step
        moved.flat[i] = x.flat[i]
    return g


class Part:
    def __init__(self, name, title):
        self.name, self.title = name, title
        self.tensors, self.meta, self.cases = {}, {}, {}

    def put(self, name, value, error=None):
        """Adds a tensor. One with an error of single precision is a result, and has a tolerance."""
        small = error is not None and np.size(value) <= 1000
        value = np.asarray(value, np.float64 if small else np.float32)
        self.tensors[name] = value
        self.meta[name] = {"dtype": str(value.dtype), "shape": list(value.shape)}
        if error is not None:
            top = float(np.abs(value).max())
            self.meta[name] |= {
                "max_abs": top,
                "f32_max_abs_err": float(error),
                "tol_abs": max(10 * float(error), 2e-6 * top, 1e-12),
            }

    def case(self, name, function, moving, inputs, config, note, cotangent):
        """Adds a case: its inputs, every output, and its gradients with respect to the inputs in `moving`."""
        self.cases[name] = {"config": config, "grads": moving, "note": note}
        for key, value in inputs.items():
            self.put(f"{name}/in.{key}", value)

        def run(real, key, x):
            return function(**({k: v.astype(real) for k, v in inputs.items()} | {key: x}))

        # One input is complex, so that complex64 is used in the second run.
        first = moving[0]
        exact = run(np.float64, first, inputs[first].astype(np.complex128))
        single = run(np.float32, first, inputs[first].astype(np.complex64))
        self.cases[name]["pulls"] = {o: [o] for o in exact}
        for o, value in exact.items():
            self.put(f"{name}/out.{o}", value.real, np.abs(value.real - single[o].real).max())
            cot = cotangent(np.shape(value))
            self.put(f"{name}/cot.{o}", cot)
            for key in moving:
                x = inputs[key]
                pulled = lambda real: lambda z: (cot.astype(real) * run(real, key, z)[o]).sum()
                g = gradient(pulled(np.float64), x.astype(np.float64), np.complex128)
                s = gradient(pulled(np.float32), x.astype(np.float32), np.complex64)
                self.put(f"{name}/grad.{o}.{key}", g, np.abs(g - s).max())

    def write(self, folder):
        """Writes NAME.json and NAME.safetensors."""
        with open(f"{folder}/{self.name}.json", "w") as file:
            info = {"cases": self.cases, "part": self.name, "tensors": self.meta, "title": self.title}
            json.dump(info, file, indent=1, sort_keys=True)
            file.write("\n")
        header, blob = {}, b""
        for name in sorted(self.tensors):
            data = self.tensors[name].tobytes()
            kind = {"float64": "F64", "float32": "F32"}[str(self.tensors[name].dtype)]
            offsets = [len(blob), len(blob) + len(data)]
            header[name] = {"dtype": kind, "shape": list(self.tensors[name].shape), "data_offsets": offsets}
            blob += data
        head = json.dumps(header).encode()
        head += b" " * (-len(head) % 8)
        with open(f"{folder}/{self.name}.safetensors", "wb") as file:
            file.write(struct.pack("<Q", len(head)) + head + blob)
