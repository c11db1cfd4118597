"""`calib-ros steps`: every intermediate picture of the method for one frame, and the page that shows them."""
