"""Still poses: grids, poses chosen for information, their order and the ways between them."""
