"""How well the models find what demonstrators were going for: `make study`.

One module for each part, whose cases run in processes of their own; what they share is in
`scores`, `intervals`, `report` and `part`. A new model takes part as soon as `Settings` knows it;
what is its own is a line in `reliability.SIMULATORS`.
"""
