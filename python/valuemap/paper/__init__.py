"""The paper's method, one stage a file: Dabisias, Ruffaldi, Grimmett and Ondruska, "VALUE", ICRA 2018."""
