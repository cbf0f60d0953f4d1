"""From files to a tilt series: images, what the microscope wrote into them, and what is wrong with them."""
