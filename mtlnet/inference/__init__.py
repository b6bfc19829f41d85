"""Running a published model on images, without torch: all of mtlnet that `serve` may import."""
