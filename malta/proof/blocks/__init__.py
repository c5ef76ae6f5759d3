"""Complex blocks beside real parameters: dynamic margins and worst-case gains."""
