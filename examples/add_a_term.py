"""A structure with one more term: its regressors and bias terms follow by themselves."""

import greybox as gb

structure = gb.get_structure("thesis").with_terms("N_|r|r")
for line in structure.equations():
    print(line)

ahead_to_starboard = (("u", (1,)), ("v", (1,)))
for state in structure.states:
    predictor = gb.build_predictor(structure, "augmented", ahead_to_starboard)
    print(state, [predictor.columns[i].label for i in predictor.equation(state)])
