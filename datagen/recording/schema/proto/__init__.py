"""Our own messages. `driverview_pb2` is made from `driverview.proto` by protoc 29, in this folder:

python -m grpc_tools.protoc -I. --python_out=. --pyi_out=. driverview.proto  (grpcio-tools 1.71)
"""
