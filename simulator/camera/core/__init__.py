"""The camera, its projection, and its OpenGL context, meshes and render targets."""
