"""What a training costs, on a CPU and on a GPU."""
