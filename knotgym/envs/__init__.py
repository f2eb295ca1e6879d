"""Tasks, rewards and the Gymnasium environments."""
