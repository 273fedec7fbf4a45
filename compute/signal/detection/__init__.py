"""Detection of faint peaks at a chosen false-alarm rate: matched filter and threshold."""
