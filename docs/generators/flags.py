"""Print the table of docs/reference/flags.md, from `compute.measurement.flag_policy`."""

from compute.flags import flag_names
from compute.measurement.flag_policy import (
    FIT_RULES,
    KNOWN_SHAPE_RULES,
    SHADOW_RULES,
    STANDARD_RULES,
)


def policy_table() -> str:
    """Return the rules as a Markdown table."""
    rows = [
        "| flag | where | use | standard deviation | starts a track or tool | clear | why |",
        "|---|---|---|---|---|---|---|",
    ]
    for where, rules in (
        ("in general", STANDARD_RULES),
        ("fitted peaks", FIT_RULES),
        ("stripes of known shape", KNOWN_SHAPE_RULES),
        ("shadows of coded windows", SHADOW_RULES),
    ):
        for rule in rules:
            sigma = "as stated" if rule.sigma_factor == 1.0 else f"x {rule.sigma_factor:g}"
            if rule.added_sigma_px:
                sigma = f"and {rule.added_sigma_px:g} px, in squares"
            if rule.use == "refused":
                sigma = ""
            use = f"{rule.use}, not for tools" if rule.shared else rule.use
            (name,) = flag_names(rule.flag)
            start = "yes" if rule.initiates else "no"
            clear = "yes" if rule.clear else "no"
            rows.append(
                f"| `{name}` | {where} | {use} | {sigma} | {start} | {clear} | {rule.why} |"
            )
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    print(policy_table(), end="")
