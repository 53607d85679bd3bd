"""Response curves and merged radiance by OpenCV on the stacks of server/lumisphere/src/capture/exposure_tests.rs (same formulas, other noise).

    python3 -m venv rivals && rivals/bin/pip install opencv-python-headless numpy
    rivals/bin/python docs/rivals/exposures.py

One line per curve and noise: ln RMS of CalibrateDebevec's curve over codes 5 to 250 at the best scale, worst channel; relative RMS of
MergeDebevec's radiance at the median scale, worst channel; CPU milliseconds of both on one thread.
"""

import time

import cv2
import numpy as np

WIDTH, HEIGHT = 160, 120


def filmic(x):
    return x * (6.2 * x + 0.5) / (x * (6.2 * x + 1.7) + 0.06)


CURVES = {
    "straight": lambda x: x,
    "srgb": lambda x: np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055),
    "power": lambda x: x ** (1 / 2.2),
    "logarithm": lambda x: np.log(1 + 60 * x) / np.log(61),
    "filmic": lambda x: filmic(4 * x) / filmic(4.0),
}


def scene():
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / np.array([HEIGHT, WIDTH])[:, None, None]
    smooth = 0.5 + 0.45 * np.sin(6 * np.pi * x + 1) * np.cos(4 * np.pi * y + 0.5) + 0.03 * (np.sin(40 * x) + np.cos(31 * y))
    tint = np.array([-0.05, 0.0, 0.05]) * np.sin(5 * x)[..., None]
    return 1000.0 ** (np.clip(smooth[..., None] + tint, 0, 1) - 1)


def curve_error(response, curve):
    codes = np.arange(5, 251)
    fine = np.exp(np.linspace(np.log(1e-9), 0, 400001))
    truth = np.interp(codes / 255, curve(fine), np.log(fine))
    errors = []
    for channel in range(3):
        apart = np.log(response[codes, 0, channel]) - truth
        errors.append(np.sqrt(np.mean((apart - apart.mean()) ** 2)))
    return max(errors)


def radiance_error(merged, truth):
    errors = []
    for channel in range(3):
        ratio = merged[..., channel] / truth[..., channel]
        errors.append(np.sqrt(np.mean((ratio / np.median(ratio) - 1) ** 2)))
    return max(errors)


def main():
    cv2.setNumThreads(1)
    print(f"OpenCV {cv2.__version__}")
    truth = scene()
    times = (0.9 * 2.0 ** np.arange(8)).astype(np.float32)
    for name, curve in CURVES.items():
        for noise in (0.0, 0.01):
            random = np.random.default_rng(1)
            shots = [truth * t * (1 + noise * random.standard_normal(truth.shape)) for t in times]
            images = [np.round(255 * curve(np.clip(shot, 0, 1))).astype(np.uint8) for shot in shots]
            start = time.process_time()
            response = cv2.createCalibrateDebevec().process(images, times)
            recovered = time.process_time()
            merged = cv2.createMergeDebevec().process(images, times, response)
            done = time.process_time()
            print(
                f"{name:10s} noise {noise:.2f}: curve {curve_error(response, curve):.4f}, radiance {radiance_error(merged, truth):.4f}, "
                f"{1e3 * (recovered - start):.0f} + {1e3 * (done - recovered):.1f} ms, finite {np.isfinite(response).all()}"
            )


if __name__ == "__main__":
    main()
