"""Pictures of the rope: camera, renderers, varied appearance, diagrams and videos."""
