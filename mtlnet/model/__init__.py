"""The network: its architectures, its layers in torch, and faster kernels for training on a CPU."""
