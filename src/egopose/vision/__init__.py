"""The wearer's video: rendering it, decoding it, its optical flow, and the encoders that turn flow into features."""
