"""Detection of faint peaks at a chosen rate of false alarms: a matched filter and its threshold."""
