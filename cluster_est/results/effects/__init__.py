"""What effects add, over the variable that they depend on, where the data were."""
