"""Errors of Tests 5.1 to 5.8 as the thesis prints them."""

from compute.calibration.result import AxisErrors

DLT = "thesis: DLT"
BUNDLE = "thesis: BA"

PUBLISHED: dict[str, dict[str, AxisErrors]] = {
    # Order: mean absolute, largest absolute, mean, standard deviation; X, Y, Z in mm.
    "test-5.1": {  # Table 5.1, 12 points; Appendix F
        DLT: AxisErrors(
            12, (0.97, 0.13, 0.06), (3.86, 0.34, 0.19), (0.57, 0.08, 0.02), (1.28, 0.15, 0.08)
        ),
    },
    "test-5.2": {  # Tables 5.6 and 5.7; Appendix F
        DLT: AxisErrors(
            12,
            (0.1545, 0.0119, 0.0117),
            (0.4835, 0.0487, 0.0557),
            (-0.0098, -0.0004, 0.0004),
            (0.2167, 0.0178, 0.0200),
        ),
        BUNDLE: AxisErrors(
            12,
            (2.92e-11, 2.62e-12, 1.89e-12),
            (9.46e-11, 1.09e-11, 1.05e-11),
            (-2.27e-11, 9.00e-14, -7.20e-13),
            (3.39e-11, 4.21e-12, 3.40e-12),
        ),
    },
    "test-5.3": {  # Appendix G
        DLT: AxisErrors(
            19,
            (5.00, 10.00, 61.67),
            (14.59, 36.50, 195.07),
            (-0.21, -3.76, -23.31),
            (6.70, 14.68, 82.55),
        ),
    },
    "test-5.4": {  # Appendix G
        DLT: AxisErrors(
            19,
            (3.57, 4.60, 16.04),
            (11.79, 12.68, 46.81),
            (0.48, -0.39, -3.94),
            (4.86, 6.07, 20.10),
        ),
    },
    "test-5.5": {  # Table 5.8
        DLT: AxisErrors(
            19,
            (5.71e-4, 8.61e-4, 3.53e-3),
            (2.06e-3, 3.01e-3, 1.02e-2),
            (1.20e-5, -6.10e-5, -2.10e-4),
            (7.79e-4, 1.16e-3, 4.49e-3),
        ),
        BUNDLE: AxisErrors(
            19,
            (6.13e-14, 1.32e-13, 8.14e-13),
            (2.27e-13, 4.55e-13, 3.64e-12),
            (1.80e-14, 1.32e-13, 2.39e-13),
            (1.00e-13, 1.94e-13, 1.35e-12),
        ),
    },
    "test-5.6": {  # Table 5.8
        DLT: AxisErrors(
            19,
            (1.99e-4, 2.50e-4, 6.83e-4),
            (5.11e-4, 6.69e-4, 3.07e-3),
            (5.23e-5, -2.00e-7, 4.89e-4),
            (2.59e-4, 3.20e-4, 8.28e-4),
        ),
        BUNDLE: AxisErrors(
            19,
            (1.03e-13, 2.75e-13, 8.14e-13),
            (4.55e-13, 1.36e-12, 3.64e-12),
            (-1.65e-14, 2.51e-13, 1.92e-13),
            (1.55e-13, 3.76e-13, 1.25e-12),
        ),
    },
    "test-5.7": {  # Table 5.9, right half
        DLT: AxisErrors(
            19,
            (0.0151, 0.0171, 0.0494),
            (0.0409, 0.0610, 0.1027),
            (0.0073, -0.0139, -0.0189),
            (0.0176, 0.0227, 0.0575),
        ),
    },
    "test-5.8": {  # Table 5.9, left half
        DLT: AxisErrors(
            19,
            (0.0016, 0.0007, 0.0158),
            (0.0044, 0.0015, 0.0373),
            (0.0002, -0.0002, 0.0044),
            (0.0019, 0.0008, 0.0182),
        ),
    },
}

PRINCIPAL_POINTS_MM: dict[str, tuple[float, float, float, float]] = {
    # "Distance to the principal point", Appendices F to H.
    "test-5.1": (11.12, 12.12, 11.38, 19.95),
    "test-5.2": (12.29, 12.21, 12.02, 12.26),
    "test-5.3": (11.14, 2.12, 3.81, 4.43),
    "test-5.4": (9.32, 3.81, 2.72, 9.07),
    "test-5.5": (2.54, 3.39, 2.54, 2.52),
    "test-5.6": (2.5406, 3.3895, 2.5411, 2.5388),
    "test-5.7": (2.5376, 3.3930, 2.5447, 2.5232),
    "test-5.8": (2.5406, 3.3895, 2.5411, 2.5388),
}
