"""What people look at: tables, figures, the HTML page, the explanation of a cell."""
