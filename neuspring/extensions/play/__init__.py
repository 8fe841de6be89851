"""The playground: runs of a results folder in the browser, and twins to pull with the mouse."""
