"""The rope: its model, kinematics, simulation and actions."""
