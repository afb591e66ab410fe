"""Live estimation: a camera, file or address in, the humanoid's motion out, in step with time."""
