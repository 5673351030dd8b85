"""Solvers of the point-wise problem: two backends behind one interface, and the schedules that use them."""
