"""Coverage of an area by pictures: ground seen well enough, ground missed, and the causes."""
