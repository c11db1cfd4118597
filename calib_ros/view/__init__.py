"""What a page shows of an extrinsic: pictures, numbers and clouds, without any library of the web."""
