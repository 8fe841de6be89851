"""The playground: runs of a results folder in the browser, in space and time, and twins that can be pulled."""
