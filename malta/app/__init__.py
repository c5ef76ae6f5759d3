"""A page to design with, in a browser (`malta app`) or a notebook (`malta.app_widget`): every move is seen at once."""
