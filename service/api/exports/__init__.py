"""Points, tracks and tool poses of a recording or a captured stream, as files of other programs."""
