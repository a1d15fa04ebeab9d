"""The full mechanism under inputs."""
