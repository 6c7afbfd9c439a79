"""What a bake costs and how exact it is: error against time for every way to do it, and what errs in a picture."""
