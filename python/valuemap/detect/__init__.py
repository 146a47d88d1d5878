"""From pictures to detections: networks are run with ONNX Runtime and trained with PyTorch.

Nothing slow is imported here, so that nobody waits for a library that is not needed.
"""

from pathlib import Path

BUNDLED_MODEL = Path(__file__).parent / "models" / "traffic_lights.onnx"
"""A small segmentation model for traffic lights; docs/model_card.md says how good it is."""
