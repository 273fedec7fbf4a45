"""The measurement model, the measurements of an exposure and the policy for peak flags."""
