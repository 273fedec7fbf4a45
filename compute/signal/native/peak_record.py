"""Native source: constants, the records, and the thresholds and variances of pixels."""

from typing import Final

import numpy as np

from compute.signal.centroid_settings import FRACTION_UNIT, GROUP_PIXELS, LEVEL_UNIT, SAMPLE_GROUPS
from compute.signal.peaks import PeakFlag

PEAK_RECORD: Final = np.dtype(
    [
        ("position_px", "<f8"),
        ("sigma_px", "<f4"),
        ("amplitude", "<f4"),
        ("width_px", "<f4"),
        ("flags", "<i4"),
    ]
)
"""One peak as the kernel writes it."""


def line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: count, background [1/64 count], room for peaks."""
    head = [("count", "<i4"), ("background", "<i4")]
    return np.dtype([*head, ("peaks", PEAK_RECORD, (max_peaks,))])


CONSTANTS: Final = f"""
    const int level_unit = {LEVEL_UNIT};
    const int fraction_unit = {FRACTION_UNIT};
    const int group_pixels = {GROUP_PIXELS};
    const int sample_groups = {SAMPLE_GROUPS};
    const int saturated = {PeakFlag.SATURATED:d}, clipped = {PeakFlag.CLIPPED:d};
    const int merged = {PeakFlag.MERGED:d}, truncated = {PeakFlag.TRUNCATED:d};
    const int no_key = 0x7fffffff;
"""

# A pixel is an unsigned short. Line: its pixels, the noise of its sensor, its background.
TYPES: Final = """
    struct Record { double position; float sigma, amplitude, width; int flags; };
    struct Level { int background, limit; };
    // Whether memory before and behind a line's pixels holds dark ones.
    struct Padded { constexpr operator bool() const { return true; } };
    struct Bare { constexpr operator bool() const { return false; } };
    struct Line {
        const unsigned short* v;
        double dark, photon, offset;
        int full_scale, background;
    };
    auto record_of = [&](int line) -> char* {
        return (char*)records_address + (long long)line * record_bytes;
    };
    auto line_of = [&](int line, int sensor) -> Line {
        return Line{
            (const unsigned short*)lines_address + (long long)line * pixels,
            ((const double*)dark_variance_address)[sensor],
            ((const double*)photon_variance_address)[sensor],
            ((const double*)offset_address)[sensor],
            ((const int*)full_scale_address)[sensor], 0};
    };
    // A peak's own threshold, in 1/level_unit counts, and the least count above it.
    auto threshold_of = [&](int background, int value) -> int {
        const int excess = value * level_unit - background;
        return background + (int)((long long)excess * fraction_units / fraction_unit);
    };
    auto cut_of = [&](int background, int value) -> int {
        return threshold_of(background, value) / level_unit + 1;
    };
    auto lesser = [](int a, int b) -> int { return a < b ? a : b; };
    auto greater = [](int a, int b) -> int { return a > b ? a : b; };
"""

# Background and limit from the groups' first quartile and first sixteenth, by rank. Keys are
# unique, since the group's number is in their low bits.
LEVEL: Final = """
    const int groups = lesser(pixels / group_pixels, sample_groups);
    // Nearly always by a constant, which is quicker.
    const int group_step = groups == sample_groups ? (pixels - group_pixels) / (sample_groups - 1)
                                                   : (pixels - group_pixels) / (groups - 1);
    const int rank_quartile = (groups - 1) / 4, rank_sixteenth = (groups - 1) / 16;
    auto group_key = [&](const unsigned short* v, int group) -> int {
        const unsigned short* first = v + group * group_step / group_pixels * group_pixels;
        int sum = 0;
        for (int i = 0; i < group_pixels; ++i) sum += first[i];
        return sum * sample_groups + group;
    };
    auto level_of = [&](const Line& line, int quartile_key, int sixteenth_key) -> Level {
        const int quartile = quartile_key / sample_groups;
        const int sixteenth = sixteenth_key / sample_groups;
        const int background = quartile * (level_unit / group_pixels);
        const double spread =
            double((quartile - sixteenth) * (level_unit / group_pixels)) / level_unit;
        double light = double(background) / level_unit - line.offset;
        if (light < 0.0) light = 0.0;
        double sigma = sqrt(line.dark + line.photon * light);
        if (sigma < spread) sigma = spread;
        const double level = ceil(double(background) / level_unit + detection_sigma * sigma);
        return Level{background, level > 65536.0 ? 65536 : (int)level};
    };
"""
