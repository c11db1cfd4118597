"""A score whose optimum and curvature are known."""

from __future__ import annotations

import numpy as np

from calib_ros import se3
from calib_ros.registration.initial_guess import nominal

OPTIMUM = se3.exp(np.array([0.02, -0.01, 0.03, 0.2, -0.1, 0.05])) @ nominal()
CURVATURE = np.diag([40.0, 30, 20, 0.4, 0.2, 0.3])
CURVATURE[0, 4] = CURVATURE[4, 0] = 1.5  # pitch and height nearly stand in for each other, as in real scenes


class Bowl:
    """Quadratic in the twist from the optimum; counts its evaluations."""

    def __init__(self, optimum=OPTIMUM, curvature=CURVATURE, top=0.7):
        self.optimum, self.curvature, self.top = optimum, curvature, top
        self.calls = 0

    def value(self, T):
        self.calls += 1
        xi = se3.log(T @ se3.inverse(self.optimum))
        return self.top - 0.5 * float(xi @ self.curvature @ xi)

    def linearise(self, T):
        xi = se3.log(T @ se3.inverse(self.optimum))
        return -self.curvature @ xi, self.curvature.copy()
