"""The viewer in the browser: evaluations, estimates, forecasts and motions, played side by side (extra ``view``)."""
