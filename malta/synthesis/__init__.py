"""Controllers: design files, Riccati equations, LQG, and the law that all else consumes."""
