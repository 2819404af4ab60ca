"""Pictures and pages from plain arrays; knows nothing of the project."""

from evercal.drawing.charts import accuracy_against_size as accuracy_against_size
from evercal.drawing.charts import error_curve as error_curve
from evercal.drawing.charts import error_histogram as error_histogram
from evercal.drawing.charts import forgetting_curves as forgetting_curves
from evercal.drawing.charts import kept_places as kept_places
from evercal.drawing.charts import scene_bars as scene_bars
from evercal.drawing.charts import trajectory as trajectory
from evercal.drawing.overlay import contact_sheet as contact_sheet
from evercal.drawing.overlay import encode_image as encode_image
from evercal.drawing.overlay import overlay_lines as overlay_lines
from evercal.drawing.overlay import overlay_points as overlay_points
from evercal.drawing.page import Picture as Picture
from evercal.drawing.page import Section as Section
from evercal.drawing.page import Table as Table
from evercal.drawing.page import html_page as html_page
from evercal.drawing.uncertainty import ellipsoid_shadows as ellipsoid_shadows
from evercal.drawing.uncertainty import error_terms as error_terms
from evercal.drawing.uncertainty import residual_bars as residual_bars
