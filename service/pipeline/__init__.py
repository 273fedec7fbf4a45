"""The live pipeline: driver -> ring -> peaks -> points -> hub -> streams."""
