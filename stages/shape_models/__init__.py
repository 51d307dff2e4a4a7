"""Encoders of shape: surfaces and rooms that they are trained on, predictions, ONNX graphs."""
