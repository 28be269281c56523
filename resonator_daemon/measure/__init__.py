"""Frames of a board to readings and messages: sensors, the pipeline, the decoder process."""
