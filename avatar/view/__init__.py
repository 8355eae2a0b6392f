"""`avatar view`: an avatar at interactive rate in a browser, drawn by the program's own splatter, and driven live."""
