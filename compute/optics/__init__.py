"""Forward physics: from points of light to what a line sensor counts."""
