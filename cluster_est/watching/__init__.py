"""Views of running runs, read only from their folders, and a web page that shows them."""
