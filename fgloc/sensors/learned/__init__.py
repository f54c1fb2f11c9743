"""Learned motion, inference only: numpy and safetensors, no torch."""
