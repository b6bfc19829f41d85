"""Writing trained networks for deployment: OpenVINO graph, int8, ONNX, the model in a run's
folder."""
