"""The rival of benches/fitting: SciPy's least_squares(trf), one problem a texel, one thread; it stands for lsqcurvefit.

    python3 -m venv target/scipy && target/scipy/bin/pip install scipy==1.17.1 numpy

Usage: scipy_lobes.py SAMPLES TEXELS VIEWS LOBES. Samples, model, bounds and start as in ceres_lobes.cpp. Fits the first 32 texels. Prints, for
analytic and for two-point derivatives: microseconds of processor time per texel and root mean square residual.
"""

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"

import sys
import time

import numpy as np
from scipy.optimize import least_squares

PROBLEMS = 32


def model(p, d, lobes, jacobian):
    views = len(d)
    value = np.tile(p[:3], (views, 1))
    j = np.zeros((views, 3, len(p)))
    j[:, range(3), range(3)] = 1
    for k in range(lobes):
        q, at = p[3 + 6 * k : 9 + 6 * k], 3 + 6 * k
        z = np.sqrt(max(1 - q[3] ** 2 - q[4] ** 2, 1e-9))
        cosine = np.maximum(d @ np.array([q[3], q[4], z]), 1e-9)
        lit = cosine > 1e-9
        log = np.log(cosine)
        lobe = np.where(lit, np.exp(q[5] * log), 0)
        value += lobe[:, None] * q[:3]
        if jacobian:
            slope = q[5] * lobe / cosine
            for c in range(3):
                j[:, c, at + c] = lobe
                j[:, c, at + 3] = q[c] * slope * (d[:, 0] - q[3] / z * d[:, 2])
                j[:, c, at + 4] = q[c] * slope * (d[:, 1] - q[4] / z * d[:, 2])
                j[:, c, at + 5] = q[c] * lobe * log
    return value, j


def start(d, y, lobes):
    mean = y.mean(axis=0)
    p, free = list(mean), np.ones(len(d), bool)
    for _ in range(lobes):
        best = np.argmax(np.where(free, y.sum(axis=1), -np.inf))
        free &= d @ d[best] < 0.94
        p += list(np.maximum(0.01, y[best] - mean)) + [d[best, 0], d[best, 1], 10.0]
    return np.array(p)


def main():
    path, texels, views, lobes = sys.argv[1], *map(int, sys.argv[2:5])
    samples = np.fromfile(path, np.float32).astype(float).reshape(texels, views, 6)[:PROBLEMS]
    low = np.array([0.0] * 3 + [0, 0, 0, -1, -1, 1] * lobes)
    high = np.array([np.inf] * 3 + [np.inf, np.inf, np.inf, 1, 1, 1000] * lobes)
    for name in ("analytic", "two_point"):
        cost, begin = 0.0, time.process_time()
        for texel in samples:
            d, y = texel[:, :3], texel[:, 3:]
            residuals = lambda p: (model(p, d, lobes, False)[0] - y).ravel()
            analytic = lambda p: model(p, d, lobes, True)[1].reshape(3 * views, -1)
            p = np.clip(start(d, y, lobes), low + 1e-6, high - 1e-6)
            jac = analytic if name == "analytic" else "2-point"
            cost += 2 * least_squares(residuals, p, jac=jac, bounds=(low, high), method="trf").cost
        print(f"{name}_us {1e6 * (time.process_time() - begin) / len(samples):.2f}")
        print(f"{name}_rms {np.sqrt(cost / (3 * views * len(samples))):.9g}")


main()
