"""Descriptions of members of the OpenAPI document that mean the same wherever they occur.

A member is described at its field, or in the ``Args`` of its class's docstring; what neither says
stands here: by name, or by schema and name where a name has several meanings.
"""

import re
from typing import Any, Final

MEMBERS: Final[dict[str, str]] = {
    "above_sigma": "Pixels so many standard deviations above the fit count as light and are left "
    "out of the next round.",
    "active_calibration_id": "The calibration that its points are computed with; null: none.",
    "actor": "Who did it.",
    "address": "The IP address that the request came from.",
    "against": "What the readings were compared with.",
    "age_s": "Age of the newest exposure [s].",
    "ambiguity_probability": "Probability of a wrong shadow above which a reading is `ambiguous`.",
    "aperture": "Pixels that the median is taken of.",
    "applied": "Whether the tool got the tip or axis that was found.",
    "areas": "The weighted areas of the thesis; null: left out.",
    "autostart": "Whether it starts with the server.",
    "average": "Consecutive scans that are averaged.",
    "AxisErrors.points": "Number of points.",
    "AxisSummary.best": "The smallest value.",
    "AxisSummary.median": "The median.",
    "AxisSummary.worst": "The largest value.",
    "background": "The light beside the peaks that is subtracted.",
    "calibration_id": "The calibration.",
    "calibrations": "The calibrations that were active while it was recorded.",
    "capture_id": "The capture session that the readings come from.",
    "captured": "What has been captured so far.",
    "cause": "Why the beam is held, in a word that programs understand.",
    "cells": "Number of cells along x, y and z.",
    "Chart.centre": "The value about which the limits lie; null: not enough values yet.",
    "charts": "A control chart for each quantity that is followed.",
    "check": "The drift that was found, and its significance.",
    "chi2": "Chi-square of the fit.",
    "comparison": "The differences and their significance.",
    "compensation": "How the filter's delay is corrected: zero phase, shifted positions, or not.",
    "content_hash": "SHA-256 of what is stored, by which it is recognised elsewhere.",
    "contents": "What the frames of the file hold.",
    "context": "The values of the message by name.",
    "covariance": "Its covariance: of a small rotation [rad], and of the translation [mm].",
    "covariance_mm2": "Its 3 x 3 covariance [mm^2]; null without a position.",
    "covariances_mm2": "Covariance of each position [mm^2].",
    "created_by": "Who made it.",
    "degree": "Degree of the polynomial, or of the spline.",
    "detail": "What was wrong, with the value, and what would be right.",
    "detection_sigma": "Smallest height of a peak, in standard deviations of the noise.",
    "detector": "The detector's type, pixels and noise.",
    "device_id": "The device's id.",
    "DeviceChange.station": "The station that it is connected to; null: this server itself.",
    "DeviceStateDocument.bad_pixels": "Pixels that its frames have shown to be bad; masked.",
    "DeviceStateDocument.frames_dropped_compute": "Frames that the compute thread had no time for.",
    "DeviceStateDocument.frames_lost": "Exposures missing in the device's sequence numbers.",
    "DeviceStateDocument.frames_not_tracked": "Frames that the tracker had no time for.",
    "DeviceStateDocument.frames_processed": "Frames that were published.",
    "DeviceStateDocument.frames_received": "Frames received from the driver.",
    "DeviceStateDocument.link": "Its link, of a device that can be unplugged; null of others.",
    "DeviceStateDocument.radiometric_id": "The radiometric calibration in use; null: none.",
    "DeviceStateDocument.subscribers": "Connected streams.",
    "dof": "Degrees of freedom of the fit.",
    "duration_s": "How long was measured [s].",
    "earlier": "Readings of the same marker at the earlier time.",
    "earlier_capture_id": "The capture session of the earlier readings; null: the control points.",
    "errors": "Errors of the control points.",
    "expires_at": "Until when it is valid; null: until it is revoked.",
    "exposure_ns": "When it was exposed, on the host's clock [ns since 1970 UTC].",
    "external_reliability_mm": "Largest shift of the position that an undetected error of one "
    "reading would cause [mm]; null where nothing checks a reading.",
    "false_alarms_per_line": "Peaks that pure noise may produce in a scan, on average.",
    "false_split_rate": "How often one line may be taken for two.",
    "fiducials": "Pairs of points: in the new frame, and as measured.",
    "filter_after": "A filter of the scan without its background; null: none.",
    "finished_at": "When it ended; null: it has not.",
    "first_px": "The first pixel.",
    "flags": "What is unusual about it; without a position, why.",
    "format": "The file's format.",
    "frame_id": "The frame's name: `tracker`, a tool, or a registration.",
    "frame_mm": "Its position in the frame of the calibration target [mm].",
    "FrameList.frames": "The frames of the device, and whether each is known now.",
    "frames": "How many frames were averaged.",
    "full_scale_counts": "Count of a saturated pixel.",
    "grid": "Where the table's cells are.",
    "Health.status": "`ok`: the process answers.",
    "hold_id": "The beam hold's id.",
    "id": "Its id.",
    "in_words": "What was found, as a sentence for people.",
    "items": "The part of the list.",
    "keep_fraction": "Part of the light about a maximum that is kept.",
    "kind": "Which kind it is; it decides which other members there are.",
    "level_fraction": "Height of the threshold as a fraction of the largest value.",
    "light_electrons": "Light of each line [electrons].",
    "limits": "How good a pose, or how near the reference, it has to be.",
    "line_filter": "A filter of the scan; null: none.",
    "links": "Paths to begin with.",
    "lower": "Lower limit; null: none yet.",
    "margin_px": "Pixels beside the light that are left out, too.",
    "marker": "The strobed marker, from 0.",
    "marker_mm": "Positions of its markers [mm].",
    "markers": "The markers, from 0.",
    "markers_mm": "Positions of the markers in the tool's frame [mm].",
    "markers_used": "Markers that the pose was computed from.",
    "mask": "Which pixels about the peaks are cut out.",
    "max_absolute_mm": "Largest absolute error [mm].",
    "max_joint_peaks": "Most overlapping lines that are fitted together.",
    "max_peaks": "Most peaks of a scan; of more the highest are kept.",
    "mean_absolute_mm": "Mean absolute error [mm].",
    "mean_mm": "Mean error [mm].",
    "mean_px": "Mean reading [px].",
    "meaning": "What it means, for people.",
    "measured_mm": "Its measured position [mm].",
    "media_type": "Media type of the file.",
    "message": "What is wrong with the value.",
    "method": "Which method; it decides which other members there are.",
    "min_depth": "Smallest depth of the valley between two peaks, as a fraction.",
    "min_width_px": "Smallest width of a peak [px].",
    "misfit_probability": "Probability of a worse fit below which a shadow is a `poor-fit`.",
    "name": "Its name.",
    "noise": "Where the standard deviation of the noise comes from.",
    "note": "For people.",
    "notes": "What else is known of it.",
    "object_id": "Id of what was changed; null: no single object.",
    "observations": "How well each explains the same observations.",
    "order": "Order of the filter.",
    "origin": "How it was made.",
    "origin_mm": "The corner of the first cell [mm].",
    "other_calibration_id": "Id of the other.",
    "outcome": "Whether it was done or refused.",
    "parameters": "Difference of each parameter.",
    "parent_created_at": "When the tool that it is relative to was created; null: the tracker.",
    "peaks": "The peaks that were found.",
    "pitch_mm": "Size of a cell along x, y and z [mm].",
    "pixels": "Number of pixels, or a row of them.",
    "point_count": "Number of points.",
    "points": "The points.",
    "port": "The serial port of the board.",
    "poses": "Readings of the target in each pose, by sensor.",
    "position_mm": "Its position X, Y, Z [mm]; null where there is none.",
    "position_px": "Position of each line [px].",
    "position_sigma_mm": "Standard deviation of each coordinate of the known positions [mm].",
    "positions": "Differences of position over the control points' box.",
    "positions_mm": "Position of each marker at the reference [mm].",
    "previous_calibration_id": "The calibration that was active before; null: none.",
    "previous_radiometric_id": "The radiometric calibration that was active before; null: none.",
    "previous_table_id": "The correction table that was active before; null: none.",
    "Problem.errors": "Each value that does not fit the schema; null of other problems.",
    "Problem.status": "The status of HTTP.",
    "Problem.title": "The problem type as words.",
    "ProblemType.title": "The code as words.",
    "published": "Figures that its maker or the literature gives.",
    "radiometric_capture_id": "The session of dark and flat captures.",
    "rates": "Rates of lines and markers.",
    "reach": "Pixels on each side of a peak that are fitted, in widths of the line.",
    "Readiness.status": "`ok`: requests can be served.",
    "readings_used": "Readings that the pose was computed from.",
    "reason": "Why there is none, for people; null: there is one.",
    "reasons": "Why, for people.",
    "recordings": "The recordings that the readings are taken from.",
    "reference": "The tool that it is relative to; null: the tracker.",
    "reference_id": "The tool that it is relative to; null: the tracker.",
    "relative_light": "Light of each level relative to the others; null: not known.",
    "repeats": "How often background and filter are repeated.",
    "request": "What was asked for.",
    "residual_sigma": "Root of the chi-square per degree of freedom, about 1; null where nothing "
    "is redundant.",
    "result": "What came of it.",
    "retired_at": "When it was retired; null: it is not.",
    "revoked_at": "When it was revoked; null: it is not.",
    "rms_mm": "Root mean square of the residuals [mm].",
    "rotation": "The rotation as a 3 x 3 matrix, by rows.",
    "rounds": "How often light is left out and the rest fitted again.",
    "rules": "How the beam is held and released: gaps, settling, latch.",
    "RunProblem.status": "The status that a request would have been answered with.",
    "saturation_counts": "Count from which a pixel is saturated.",
    "scans": "One entry for each scan.",
    "scopes": "What it may do; no scope includes another.",
    "search": "How peaks are looked for before they are fitted.",
    "sensor": "The sensor's name.",
    "sensor_count": "Number of sensors.",
    "sensors": "The sensors.",
    "separation": "How close peaks are separated; null: they are not.",
    "sequence": "Number of the exposure.",
    "series": "What is followed: a point's position, a distance, a residual.",
    "settings": "Its settings; all have defaults.",
    "shape_error": "Part of the height by which the line's shape may differ from the model.",
    "sigma_px": "Standard deviation of each position [px].",
    "signal": "Why the value is an alarm; null: it is none.",
    "size_bytes": "Size of the file [bytes].",
    "slope_counts_per_px": "Slope of the background [counts/px].",
    "smoothing": "The filter of the bridged background; null: none.",
    "source": "Where the data come from; its `kind` decides which other members there are.",
    "sources": "Where the figures come from.",
    "stages": "The scan after each step, by the step's name.",
    "standard_deviation_mm": "Standard deviation of the error [mm].",
    "started_at": "When it began.",
    "state": "Its state.",
    "status": "What it is doing.",
    "stop_fraction": "Height at which the extended slope ends, as a fraction of the peak.",
    "strobe_markers": "The strobe slot of each marker, from 0; null: all are lit at once.",
    "surface": "The surface that the points are registered to.",
    "table_id": "The correction table; null: none.",
    "taps": "Number of the filter's coefficients.",
    "target": "What was shown: its name, or its shape.",
    "targets": "The targets, and what is known of each.",
    "temperature_c": "Temperature [°C]; null: not known.",
    "threshold_fraction": "Threshold of the centre of gravity as a fraction of the peak's height.",
    "tip": "Where the tip is, and how that is known; null: it has none.",
    "tip_covariance_mm2": "3 x 3 covariance of the tip [mm^2].",
    "title": "A name for people.",
    "to_frame_id": "The frame that the transform leads to.",
    "tool_id": "The tool's id.",
    "tracking": "How its markers and tools are tracked.",
    "translation_mm": "The translation [mm].",
    "unit": "Unit of the values.",
    "upper": "Upper limit; null: none yet.",
    "value": "The value.",
    "values": "The pixels' counts.",
    "version": "Version of the server.",
    "volume": "Its working volume [mm].",
    "warnings": "What to look into before it is used.",
    "watch": "What is watched, and how.",
    "WatchSample.points": "Number of points that were measured.",
    "weighting": "Weights of the pixels in the centre of gravity.",
    "widen_misfit": "Whether standard deviations grow where the model does not explain the pixels.",
    "width_sigma_px": "Standard deviation of the width of each line [px].",
    "windows": "The fitted parts of the scan.",
}

_ARGS: Final = re.compile(r"\n\nArgs:\n(?P<members>(?: {4}.*\n?|\n)*)")
_RAISES: Final = re.compile(r"\n\nRaises:\n(?: {4}.*\n?|\n)*")
_MEMBER: Final = re.compile(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)


def describe_members(schemas: dict[str, Any]) -> None:
    """Give every schema and every member a description.

    The ``Args`` of a class's docstring move to the members that they describe; its ``Raises``,
    which names Python's errors, is left out.
    """
    for name, schema in schemas.items():
        if name.startswith("Page_"):  # generic models have no docstring of their own
            schema.setdefault("description", "Part of a list.")
        if name == "JsonValue":  # pydantic describes it by nothing
            schema.setdefault("description", "Any JSON value.")
        text = _RAISES.sub("", schema.get("description", ""))
        if text:
            schema["description"] = text.rstrip()
        found = _ARGS.search(text)
        arguments = {}
        if found is not None:
            schema["description"] = text.replace(found[0], "").rstrip()
            arguments = {
                member: " ".join(words.split())
                for member, words in _MEMBER.findall(found["members"] + "\n")
            }
        short = name.rpartition("__")[2]
        for member, value in schema.get("properties", {}).items():
            if not value.get("description"):
                words = arguments.get(member) or MEMBERS.get(f"{short}.{member}")
                words = words or MEMBERS.get(member)
                if words is not None:
                    value["description"] = _sentence(words)


def _sentence(words: str) -> str:
    """Return words as a sentence, with Markdown's code marks."""
    words = words.replace("``", "`").strip()
    return words[:1].upper() + words[1:]
