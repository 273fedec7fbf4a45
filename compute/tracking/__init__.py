"""From readings over time to tracks: association, filters, identity, kinematics."""
