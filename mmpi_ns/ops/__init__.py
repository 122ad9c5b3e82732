"""Inner loops: for each operation a plain torch reference, a compiled CPU form and a GPU form."""
