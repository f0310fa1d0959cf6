"""What people look at: TensorBoard, plots, report.html."""
