"""Writing a trained network for deployment: OpenVINO graph, int8, ONNX, published run folder."""
