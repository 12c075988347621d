"""How well the models find what demonstrators were going for: `make study`.

One module for each part, whose cases run in processes of their own; what they share is in
`scores`, `intervals`, `report` and `part`. A new model takes part as soon as `Settings` knows it;
`next_action.PREDICTORS` and `reliability.SIMULATORS` need a line each for what is its own.
"""
