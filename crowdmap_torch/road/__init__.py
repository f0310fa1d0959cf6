"""The road under a drive: its normal in the camera frame, and its surface along the way (IV-C, IV-D)."""
