"""Encoders of shape as ONNX graphs, what they are taught on, and what they predict."""
