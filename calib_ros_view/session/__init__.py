"""What a page shows of an extrinsic and of a node: pictures, numbers, clouds and histories, without any library of the web."""
