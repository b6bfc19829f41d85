"""The `driverview.*` messages. protoc 29 makes `driverview_pb2` from `driverview.proto`; run here:

python -m grpc_tools.protoc -I. --python_out=. --pyi_out=. driverview.proto  (grpcio-tools 1.71)
"""
