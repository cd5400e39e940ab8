"""Models of other fields, swept by linksweep, xyzpy and pipefunc: what each takes in lines and seconds."""
