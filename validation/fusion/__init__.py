"""Case fusion: two bars with clocks of their own against eight sensors on one."""
