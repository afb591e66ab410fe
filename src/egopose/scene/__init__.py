"""From a video of a moving camera: poses, the camera, and the scene."""
