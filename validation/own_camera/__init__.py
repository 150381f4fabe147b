"""Own camera: image charges fitted to the covariances of a camera, and the table made of them."""
