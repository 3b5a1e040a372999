//! Texels: inverse mapping from texels to points on triangles (thesis 3.2.3).
