"""When and where stages run: store, planner, Dask."""
