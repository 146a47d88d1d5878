"""Where tasks run: threads of this process (`threads`), or a cluster (`ray`). The results are the same."""
