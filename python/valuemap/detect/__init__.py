"""From pictures to detections: networks are run with ONNX Runtime and trained with PyTorch.

Nothing is imported here, so that nobody waits for a library that is not needed.
"""
