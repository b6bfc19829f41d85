"""Writes trained networks for deployment: as OpenVINO graph, in int8, as ONNX, and as the model in
a run's folder."""
