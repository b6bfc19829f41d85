"""The camera, its projection, and the OpenGL context, meshes and render targets it uses."""
