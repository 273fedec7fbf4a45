"""The live pipeline: driver -> ring -> FrameProcessor (its stages) -> beam holds -> streams."""
