"""The closed rope: model, kinematics, batched simulation and actions."""
