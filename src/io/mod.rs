//! Scene files in, images and scenes out.
