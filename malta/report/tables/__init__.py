"""Tables of everything that malta computes, for a terminal."""
